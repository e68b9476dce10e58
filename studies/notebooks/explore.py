"""The interactive app: a closed loop whose controls answer at once, and a page that opens study stores.

``jaxmpc explore`` serves it. As a script, ``python -m studies.notebooks.explore``, it runs once and prints key figures.
Computing is in `studies.notebooks.loop`, drawing in `figures.explore`; here are only controls and where things go.
"""

import marimo

__generated_with = "0.25.2"
app = marimo.App(width="full", app_title="jaxmpc explore", css_file="explore.css")


@app.cell
def _():
    import marimo as mo

    return (mo,)


@app.cell
def _(mo):
    from figures import explore as draw
    from jaxmpc import html
    from jaxmpc.errors import InputError
    from studies.definition import presets
    from studies.notebooks import loop as explore

    # Ratios to the preset's own value, so that one slider serves values of any size.
    RATIOS = [2.0**k for k in range(-5, 6)]
    SLIDER = {"show_value": True, "debounce": True, "full_width": True}
    _request = mo.app_meta().request
    given_store = str(_request.meta.get("store", "")) if _request is not None else ""
    return InputError, RATIOS, SLIDER, draw, explore, given_store, html, presets


@app.cell
def _(mo):
    page = mo.ui.radio(["Run a loop", "Open a study"], value="Run a loop", inline=True)
    get_pinned, set_pinned = mo.state(None)
    return get_pinned, page, set_pinned


@app.cell
def _(mo):
    import contextlib
    import queue
    import time

    from jaxmpc.programs.clock import Clock
    from jaxmpc.programs.compilation import told

    @contextlib.contextmanager
    def compilation_shown():
        """Shows in its cell that something is compiled meanwhile; no threads but marimo's own reach the page."""
        lines = queue.SimpleQueue()

        def show():
            for line in iter(lines.get, None):
                mo.output.append(mo.md(line))

        thread = mo.Thread(target=show)
        thread.start()
        try:
            with told(lines.put):
                yield
        finally:
            lines.put(None)
            thread.join()
            mo.output.clear()

    return Clock, compilation_shown, time


@app.cell
def _(explore, mo, presets):
    controller = mo.ui.dropdown(list(explore.CONTROLLERS), value="mixed-integer")
    preset = mo.ui.dropdown(list(presets.TUNINGS), value="thesis")
    blocking = mo.ui.dropdown(list(explore.BLOCKING), value="moves")
    length = mo.ui.dropdown({"30 min": False, "22 h": True}, value="30 min")
    soft = mo.ui.switch(value=True, label="Soft MPC")
    # Shown by the cell that makes them, as all controls are: a cell that only lays them out would run, and draw every
    # one of them again, whenever one is moved.
    choices_panel = mo.vstack(
        [
            mo.Html(
                '<div style="display:grid;grid-template-columns:auto 1fr;gap:0 1rem;align-items:center;'
                f'font-size:0.9rem"><span>controller</span>{controller}<span>preset</span>{preset}'
                f"<span>blocking</span>{blocking}<span>length</span>{length}</div>"
            ),
            soft,
        ],
        gap=0.4,
    )
    return blocking, choices_panel, controller, length, preset, soft


@app.cell
def _(RATIOS, SLIDER, mo, preset, presets):
    _fields = presets.TUNINGS[preset.value]

    def _slider(label, value, unit, steps=None):
        steps = steps or [float(f"{ratio * value:.4g}") for ratio in RATIOS]
        return mo.ui.slider(steps=steps, value=value, label=f"{label} [{unit}]", **SLIDER)

    tuning = mo.ui.dictionary(
        {
            "choke_weight": _slider("choke move weight", _fields["move_weight"]["choke"], "1/%²"),
            "oil_deadzone": _slider(
                "oil deadzone", _fields["deadzone"]["oil_rate"], "m³/h", [0.5 * k for k in range(41)]
            ),
            "gas_deadzone": _slider(
                "gas deadzone", _fields["deadzone"]["gas_rate"], "m³/h", [100.0 * k for k in range(31)]
            ),
            "oil_weight": _slider("oil weight", _fields["cv_weight"]["oil_rate"], "1/(m³/h)²"),
            "gas_weight": _slider("gas weight", _fields["cv_weight"]["gas_rate"], "1/(m³/h)²"),
        }
    )
    tuning_panel = mo.vstack(list(tuning.elements.values()), gap=0.4)
    return tuning, tuning_panel


@app.cell
def _(SLIDER, explore, mo):
    def _slider(start, stop, step, value, label):
        return mo.ui.slider(start, stop, step, value=value, label=label, **SLIDER)

    scenario = mo.ui.dictionary(
        {
            "oil_setpoint": _slider(80, 240, 1, 152, "oil setpoint [m³/h]"),
            "gas_setpoint": _slider(5000, 17000, 20, 9640, "gas setpoint [m³/h]"),
            "pressure": _slider(-4, 4, 0.25, 0, "reservoir pressure change [bar]"),
            "pressure_time": _slider(0, 1790, 10, 900, "from [s]"),
            "model_choke": _slider(6, 96, 2, 50, "model: choke [%]"),
            "model_lift": _slider(2500, 9500, 250, 7500, "model: lift [m³/h]"),
        }
    )
    _sliders = list(scenario.elements.values())
    setpoint_panel = mo.vstack([mo.md(f"**Setpoints** from {explore.STEP_TIME:g} s"), *_sliders[:2]], gap=0.4)
    model_panel = mo.accordion({"Disturbance and model": mo.vstack(_sliders[2:], gap=0.4)})
    return model_panel, scenario, setpoint_panel


@app.cell
def _(choices_panel, length, mo, model_panel, page, setpoint_panel, tuning_panel):
    _step = [] if length.value else [setpoint_panel]
    _shown = [choices_panel, tuning_panel, *_step, model_panel] if page.value == "Run a loop" else []
    # panels are as high as what is in them; by themselves they would share the height of the page evenly
    _panels = [panel.style(flex="none") for panel in _shown]
    mo.sidebar([mo.vstack([page, *_panels], gap=0.4)], width="330px")
    return


@app.cell
def _(
    Clock,
    InputError,
    blocking,
    compilation_shown,
    controller,
    explore,
    length,
    mo,
    preset,
    scenario,
    soft,
    time,
    tuning,
):
    run, refused = None, None
    try:
        _settings = explore.Settings(
            controller=controller.value,
            preset=preset.value,
            soft=soft.value,
            blocking=blocking.value,
            whole=length.value,
            **tuning.value,
            **scenario.value,
        )
        if length.value:
            with (
                compilation_shown(),
                mo.status.progress_bar(total=7800, title="22 h", show_eta=True, remove_on_exit=True) as _bar,
            ):
                _done, _clock = [0], Clock()

                def _report(done, total):
                    _bar.start_time = time.time() - _clock.seconds
                    _bar.update(increment=done - _done[0])
                    _done[0] = done

                run = explore.run(_settings, _report)
        else:
            with compilation_shown():
                run = explore.run(_settings)
    except InputError as error:
        refused = mo.callout(str(error), kind="warn")
    return refused, run


@app.cell
def _(SLIDER, length, mo):
    _last = 77990 if length.value else 1790
    plan_time = mo.ui.slider(0, _last, 10, value=300, label="plan made at [s]", **SLIDER)
    return (plan_time,)


@app.cell
def _(mo, run, set_pinned):
    pin = mo.ui.button(label="Pin this run", on_click=lambda _: set_pinned(run), disabled=run is None)
    unpin = mo.ui.button(label="Unpin", on_click=lambda _: set_pinned(None))
    return pin, unpin


@app.cell
def _(draw, explore, get_pinned, html, mo, page, pin, refused, run, unpin):
    def _view():
        if run is None:
            return refused
        pinned = get_pinned()
        figure = draw.tracking(run.data, pinned=None if pinned is None else pinned.data)
        rows, runs = [], [run] if pinned is None else [run, pinned]
        for figures in zip(*map(explore.shown_figures, runs), strict=True):
            (now, shown), *before = (explore.written(value, unit) for _, unit, value in figures)
            old = (number if unit == shown else f"{number} {unit}" for number, unit in before)
            rows.append([figures[0][0], now, *old, shown])
        head = ["", *("now", "pinned")[: len(runs)], ""]
        side = [
            mo.Html(
                '<div id="key-figures" style="font-size:12px;line-height:1.3;white-space:nowrap">'
                f"{html.table(head, rows)}</div>"
            ),
            mo.hstack([pin, unpin], justify="start"),
            mo.md(f"<small>run and key figures: {run.seconds:.2f} s</small>"),
        ]
        image = mo.Html(draw.image(figure, "the run"))
        return mo.hstack([image, mo.vstack(side, gap=0.3)], widths=[2.15, 1], align="start", gap=0.75)

    _view() if page.value == "Run a loop" else None
    return


@app.cell
def _(draw, mo, page, plan_time, run):
    def _view():
        figure = draw.planned(run.data, float(plan_time.value))
        return mo.vstack([plan_time, mo.Html(draw.image(figure, "the plan"))], gap=0.3)

    _view() if page.value == "Run a loop" and run is not None else None
    return


@app.cell
def _(given_store, mo):
    path = mo.ui.text(
        value=given_store, label="study store", full_width=True, placeholder="results/deadzone.zarr"
    )
    return (path,)


@app.cell
def _(InputError, draw, mo, path):
    table, chart, trouble = None, None, mo.md("Path of a sweep (`….zarr`) or of a comparison (its folder).")
    if path.value.strip():
        try:
            table = draw.points(path.value.strip())
            chart = mo.ui.altair_chart(draw.scatter(table), chart_selection="point", legend_selection=False)
        except InputError as error:
            trouble = mo.callout(str(error), kind="warn")
    return chart, table, trouble


@app.cell
def _(chart, mo, page, path, trouble):
    mo.vstack([path, chart if chart is not None else trouble]) if page.value == "Open a study" else None
    return


@app.cell
def _(chart, draw, mo, path):
    picked = None
    if chart is not None and 0 < len(chart.value) < len(chart.dataframe):  # all of them: none is picked
        picked = chart.value.iloc[0]
    again = mo.ui.run_button(
        label="Run it in full",
        tooltip="closes this loop again and shows every sample",
        disabled=picked is None or draw.is_comparison(path.value.strip()),
    )
    return again, picked


@app.cell
def _(InputError, again, compilation_shown, draw, mo, page, path, picked):
    def _view():
        if picked is None:
            return mo.md("Pick a point to see its run.")
        store, number = path.value.strip(), int(picked["number"])
        try:
            if again.value:
                from pathlib import Path

                from figures.closed_loop import of_trajectory
                from studies.rerun import rerun

                with compilation_shown(), mo.status.spinner("running"):
                    found = rerun(Path(store), number)
                data = of_trajectory(found.trajectory, found.deadzone, found.kind, found.actuator)
            else:
                data = draw.stored(store, number)
        except InputError as error:
            return mo.callout(str(error), kind="warn")
        image = mo.Html(draw.image(draw.tracking(data, wide=True), "the picked run"))
        title = mo.md(f"**{number}**: {picked['run']}")
        return mo.vstack([mo.hstack([title, again], widths=[5, 1]), image], gap=0.3)

    _view() if page.value == "Open a study" else None
    return


if __name__ == "__main__":
    from studies.notebooks.loop import main

    main()
