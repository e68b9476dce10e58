"""The interactive app: a closed loop whose controls answer at once, and a page that opens study stores.

``jaxmpc explore`` serves it. As a script, ``python -m studies.notebooks.explore``, it runs once and prints key figures.
Computing is in `studies.notebooks.loop`, the controls of a process in `controls`, drawing in `figures.explore` and
`figures.choose`, what is made of them in `views`; here is only where things go.
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
    _request = mo.app_meta().request
    meta = _request.meta if _request is not None else {}
    if "first" in meta:
        meta["first"].loaded.wait()

    import altair  # noqa: F401  (while the first run is made, and not after it)

    from figures import choose
    from figures import explore as draw
    from jaxmpc.errors import InputError
    from studies.notebooks import controls, export, views
    from studies.notebooks import loop as explore

    return InputError, choose, controls, draw, explore, export, meta, views


@app.cell
def _(mo):
    page = mo.ui.radio(["Run a loop", "Open a study"], value="Run a loop", inline=True)
    get_pins, set_pins = mo.state(())
    kept = {"texts": {}, "zoom": None}  # what the user has set in controls that are made anew
    return get_pins, kept, page, set_pins


@app.cell
def _(InputError, explore, meta, mo, views):
    try:
        with views.compilation_shown(meta["first"].said if "first" in meta else ()):
            explored = meta["first"].explorer() if "first" in meta else explore.explorer()
    except InputError as error:
        mo.stop(True, mo.callout(str(error), kind="warn"))
    return (explored,)


@app.cell
def _(controls, explored, mo, views):
    # Shown by the cell that makes them, as all controls are: a cell that only lays them out would run, and draw every
    # one of them again, whenever one is moved.
    choices = mo.ui.dictionary(
        {
            name: mo.ui.dropdown(options, value=next(iter(options)))
            for name, options in controls.choices(explored).items()
        }
    )
    soft = mo.ui.switch(value=True, label="Soft MPC")
    choices_panel = views.chosen_of(explored.process.title or explored.process.name, choices, soft)
    return choices, choices_panel, soft


@app.cell
def _(choices, controls, explored, mo, views):
    tuning = views.sliders(controls.tuning_sliders(explored, choices.value["preset"]))
    tuning_panel = mo.vstack(list(tuning.elements.values()), gap=0.4)
    return tuning, tuning_panel


@app.cell
def _(controls, explore, explored, mo, views):
    scenario = views.sliders(controls.scenario_sliders(explored))
    _of = lambda *heads: [e for key, e in scenario.elements.items() if key.startswith(heads)]  # noqa: E731
    _from = f"<span><b>Setpoints</b> from {explore.STEP * explored.process.dt:g} s</span>"
    setpoint_panel = mo.vstack([mo.Html(_from), *_of("setpoint.")], gap=0.4)
    _more = _of("disturbance.", "model.")
    model_panel = mo.accordion({"Disturbances and model": mo.vstack(_more, gap=0.4)}) if _more else mo.md("")
    return model_panel, scenario, setpoint_panel


@app.cell
def _(controls, explored, views):
    fields = views.table(
        controls.further_fields(explored),
        "Every other setting: search, tick, and set it below",
        pagination=True,
        show_download=False,
        wrapped_columns=["setting"],
    )
    return (fields,)


@app.cell
def _(choices, controls, explored, fields, kept, mo):
    def _text(key, label, start):
        return mo.ui.text(
            value=kept["texts"].get(key, start),
            label=label,
            full_width=True,
            on_change=lambda text: kept["texts"].update({key: text}),
        )

    further = mo.ui.dictionary(
        {
            key: _text(key, label, start)
            for key, label, start in controls.chosen_fields(
                explored, choices.value["preset"], [row["key"] for row in fields.value]
            )
        }
    )
    further_panel = mo.vstack([fields, *further.elements.values()], gap=0.4)
    return further, further_panel


@app.cell
def _(controls, explored, mo):
    events = mo.ui.text_area(
        value=controls.example_lists(explored), rows=12, max_length=20000, full_width=True, debounce=True
    )
    _words = "Written as in a study file; what stands behind a `#` does not count. It holds when you leave the field."
    events_panel = mo.vstack([mo.md(f"<small>{_words}</small>"), events], gap=0.4)
    return events, events_panel


@app.cell
def _(choices, mo, model_panel, page, setpoint_panel, tuning_panel, choices_panel):
    _step = [] if choices.value["run"] else [setpoint_panel]
    _shown = [choices_panel, tuning_panel, *_step, model_panel] if page.value == "Run a loop" else []
    # panels are as high as what is in them; by themselves they would share the height of the page evenly
    _panels = [panel.style(flex="none") for panel in _shown]
    mo.sidebar([mo.vstack([page, *_panels], gap=0.4)], width="330px")
    return


@app.cell
def _(
    InputError,
    choices,
    controls,
    events,
    explore,
    explored,
    further,
    mo,
    scenario,
    soft,
    tuning,
    views,
):
    run, refused = None, None
    try:
        _base = controls.base_of(
            explored,
            choices.value,
            soft.value,
            tuning.value,
            scenario.value,
            further.value,
            events.value,
        )
        with views.compilation_shown(), views.progress_shown() as _report:
            run = explore.run(explored, _base, _report)
    except InputError as error:
        refused = mo.callout(str(error), kind="warn")
    return refused, run


@app.cell
def _(explored, mo, run, views):
    _dt, _samples = explored.process.dt, 180 if run is None else run.trajectory.samples
    plan_time = mo.ui.slider(
        0,
        (_samples - 1) * _dt,
        _dt,
        value=min(30, _samples - 1) * _dt,
        label="plan made at [s]",
        **views.SLIDER,
    )
    return (plan_time,)


@app.cell
def _(controls, get_pins, mo, run, set_pins):
    pin_name = mo.ui.text(value=controls.free_name(get_pins()), label="as", full_width=False)
    pin = mo.ui.button(
        label="Pin this run",
        on_click=lambda _: set_pins(lambda pins: controls.pinned(pins, pin_name.value, run)),
        disabled=run is None,
    )
    unpin = mo.ui.array(
        [
            mo.ui.button(
                label=f"Unpin {one.name}",
                on_click=lambda _, name=one.name: set_pins(lambda pins: controls.unpinned(pins, name)),
            )
            for one in get_pins()
        ]
    )
    return pin, pin_name, unpin


@app.cell
def _(controls, draw, get_pins, kept, page, run, views):
    chart = None
    if run is not None and page.value == "Run a loop":
        _spec = draw.tracking(controls.shown(run, get_pins()), zoom=kept["zoom"])
        chart = views.vega(_spec)
    return (chart,)


@app.cell
def _(chart, kept):
    if chart is not None:  # the next chart is zoomed in as this one is
        kept["zoom"] = (chart.selections.get("zoom") or {}).get("t")
    return


@app.cell
def _(chart, controls, get_pins, mo, page, pin, pin_name, refused, run, unpin, views):
    def _view():
        if run is None:
            return refused
        pinning = [mo.Html(views.ROW.format(f'{pin}<span style="width:7rem">{pin_name}</span>'))]
        pinning.append(mo.hstack(list(unpin.elements), justify="start", wrap=True))
        return views.of_run(chart, *controls.named(run, get_pins()), pinning, run.seconds)

    _view() if page.value == "Run a loop" else None
    return


@app.cell
def _(controls, export, get_pins, mo, page, run):
    def _view():
        table = export.differences_table(*controls.named(run, get_pins()))
        return mo.Html(f'<div id="differences" style="font-size:12px">{table}</div>')

    _view() if page.value == "Run a loop" and run is not None and get_pins() else None
    return


@app.cell
def _(events_panel, further_panel, mo, page):
    _panels = {
        "All settings": further_panel,
        "Sensor faults, disturbances and events over time": events_panel,
    }
    mo.accordion(_panels, multiple=True) if page.value == "Run a loop" else None
    return


@app.cell
def _(draw, mo, page, plan_time, run, views):
    def _view():
        return mo.vstack([plan_time, views.vega(draw.planned(run.data, float(plan_time.value)))], gap=0.3)

    _view() if page.value == "Run a loop" and run is not None else None
    return


@app.cell
def _(controls, get_pins, page, run, views):
    _shown = page.value == "Run a loop" and run is not None
    views.of_exports(run, *controls.named(run, get_pins())) if _shown else None
    return


@app.cell
def _(meta, mo):
    path = mo.ui.text(
        value=meta.get("store", ""), label="study store", full_width=True, placeholder="results/deadzone.zarr"
    )
    return (path,)


@app.cell
def _(InputError, choose, mo, path):
    runs, trouble = None, mo.md("Path of a sweep (`….zarr`) or of a comparison (its folder).")
    get_ranges, set_ranges = mo.state(())
    if path.value.strip():
        try:
            runs = choose.points(path.value.strip())
        except InputError as error:
            trouble = mo.callout(str(error), kind="warn")
    return get_ranges, runs, set_ranges, trouble


@app.cell
def _(choose, get_ranges, runs, views):
    across = None
    if runs is not None and runs.axes:
        across = views.vega(choose.parallel(runs, choose.within(runs, get_ranges())))
    return (across,)


@app.cell
def _(across, choose, get_ranges, mo, runs, set_ranges):
    dragged = () if across is None else tuple(choose.conditions(across.selections.get(choose.BRUSH)))
    _all = (*get_ranges(), *dragged)
    chosen = None if runs is None else choose.within(runs, _all)
    keep = mo.ui.button(
        label="Keep the range",
        on_click=lambda _: set_ranges(lambda old: (*old, *dragged)),
        disabled=not dragged,
    )
    clear = mo.ui.button(label="Clear", on_click=lambda _: set_ranges(()), disabled=not get_ranges())
    _words = (
        "; ".join(choose.in_words(runs, one) for one in _all)
        or "Lines of runs on the front are red. Drag over an axis to choose a range of it."
    )
    ranges_panel = mo.hstack([mo.md(f"<small>{_words}</small>"), mo.hstack([keep, clear], justify="end")])
    return chosen, ranges_panel


@app.cell
def _(choose, chosen, mo, runs):
    scatter = None
    if runs is not None:
        scatter = mo.ui.altair_chart(
            choose.scatter(runs, chosen), chart_selection="point", legend_selection=False
        )
    return (scatter,)


@app.cell
def _(across, mo, page, path, ranges_panel, scatter, trouble):
    _shown = [path, trouble] if scatter is None else [path, scatter]
    _shown += [] if across is None else [across, ranges_panel]
    mo.vstack(_shown, gap=0.4) if page.value == "Open a study" else None
    return


@app.cell
def _(choose, mo, page, runs, views):
    _shown = page.value == "Open a study" and runs is not None and len(runs.axes) > 0
    views.vega(choose.importance_chart(runs)) if _shown else None
    return


@app.cell
def _(choose, chosen, runs, views):
    rows = None
    if runs is not None:
        _columns = ["number", choose.X, choose.Y, "best", *(runs.axes or ["run"])]
        _few = runs.table[chosen].sort_values(choose.X)[_columns].rename(columns=runs.titles).round(4)
        rows = views.table(_few.to_dict("records"), "Tick runs to see them beside each other")
    return (rows,)


@app.cell
def _(mo, page, rows):
    mo.vstack([rows]) if page.value == "Open a study" and rows is not None else None
    return


@app.cell
def _(choose, mo, path, rows, runs, scatter):
    picked = []  # numbers of runs
    if scatter is not None and 0 < len(scatter.value) < len(scatter.dataframe):  # all of them: none is picked
        picked.append(int(scatter.value.iloc[0]["number"]))
    if rows is not None:
        picked += [number for number in (row["number"] for row in rows.value) if number not in picked]
    again = mo.ui.run_button(
        label="Run it in full",
        tooltip="closes this loop again and shows every sample",
        disabled=len(picked) != 1 or choose.is_comparison(path.value.strip()),
    )
    return again, picked


@app.cell
def _(InputError, again, mo, page, path, picked, runs, views):
    def _view():
        if not picked:
            return mo.md("Pick a point, or tick runs in the table, to see them.")
        try:
            return views.of_picked(path.value.strip(), picked, runs, again)
        except InputError as error:
            return mo.callout(str(error), kind="warn")

    _view() if page.value == "Open a study" else None
    return


if __name__ == "__main__":
    from studies.notebooks.loop import main

    main()
