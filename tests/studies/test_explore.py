"""The interactive app: what it computes, what it draws, how it is started, and a browser that drives it."""

import contextlib
import html
import http.client
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import jax
import numpy as np
import pytest
from studies.definition.presets import CHOKE

from figures import explore as draw
from jaxmpc.cli import main as cli
from jaxmpc.errors import InputError, MissingToolError
from studies.notebooks import launch
from studies.notebooks import loop as explore
from studies.notebooks.loop import RUN, Settings, main, run, shown_figures, written
from studies.plans import plan_at
from tests import studies_synthetic
from tests.sweep_synthetic import DEADZONE, OIL_DEADZONE, WEIGHT, grid, numbers, runs, write

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def continuous():
    return run(Settings(controller="continuous"))


@pytest.fixture(scope="module")
def mixed():
    return run(Settings())


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    values = grid([(500.0, 2.5), (1000.0, 5.0)], [62.5, 250.0])
    path = tmp_path_factory.mktemp("sweep") / "made-up.zarr"
    definition = {"study": {"name": "made-up"}, "base": {"controller": "continuous", "actuator": "step"}}
    keys = (DEADZONE, OIL_DEADZONE, WEIGHT)
    return write(path, keys, values, numbers(4), runs(4), definition)


# ------------------------------------------------------------------------------------------------- settings


def test_what_is_not_set_comes_from_the_preset():
    light, changed = Settings(preset="thesis-light"), Settings(preset="thesis-light", oil_deadzone=2.0)
    assert light.tuning.move_weight.tolist() == [62.5, 0.2]
    assert light.tuning.deadzone.tolist() == [1000.0, 5.0]
    assert changed.tuning.deadzone.tolist() == [1000.0, 2.0]
    assert changed.tuning.move_weight.tolist() == [62.5, 0.2]


def test_without_soft_mpc_the_deviation_weighs_as_much_as_far_outside_the_deadzone():
    tuning = Settings(soft=False, oil_weight=0.3).tuning
    np.testing.assert_allclose(tuning.cv_weight, [2e-4, 0.4])
    assert not np.any(tuning.soft_quadratic)
    assert not np.any(tuning.soft_linear)
    preset = Settings(preset="no-soft").tuning
    np.testing.assert_allclose(Settings(soft=False).tuning.cv_weight, preset.cv_weight)


def test_presets_are_not_changed_by_settings():
    Settings(choke_weight=1.0, gas_deadzone=0.0, soft=False).tuning  # noqa: B018
    assert Settings().tuning.move_weight[0] == 250.0


def test_only_the_mixed_integer_controller_moves_whole_steps():
    steps = {name: Settings(controller=name).structure.integer_step[0] for name in explore.CONTROLLERS}
    assert steps == {"continuous": None, "rounded": None, "mixed-integer": 2.0}


def test_the_disturbance_starts_at_its_time():
    offsets = Settings(pressure=-2.0, pressure_time=600.0).offsets
    assert len(offsets) == 180
    assert offsets[59:61].tolist() == [0.0, -2.0]


def test_the_whole_run_has_the_reference_of_the_thesis():
    assert Settings(whole=True).reference.samples(10.0) == 7800


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("controller", "fuzzy"),
        ("preset", "none"),
        ("blocking", "some"),
        ("blocking", "none"),  # whole moves without blocks take seconds each
        ("pressure", np.nan),
        ("pressure_time", np.inf),
    ],
)
def test_settings_that_do_not_exist_are_refused_by_name(field, value):
    with pytest.raises(InputError) as refused:
        Settings(**{field: value})
    assert refused.value.field == field


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"choke_weight": -1.0}, "tuning.move_weight"),
        ({"model_choke": 150.0}, "model.choke"),
        ({"oil_setpoint": np.nan}, "reference.setpoints"),
    ],
)
def test_numbers_that_no_controller_has_are_refused_before_anything_runs(changes, field):
    with pytest.raises(InputError, match=field):
        run(Settings(**changes))


# ------------------------------------------------------------------------------------------------------ runs


def test_a_run_follows_its_setpoints_with_whole_choke_moves(mixed):
    t = mixed.trajectory
    assert t.samples == 180
    assert t.setpoint[29].tolist() == [11013.0, 185.0]
    assert t.setpoint[30].tolist() == [9640.0, 152.0]
    np.testing.assert_allclose(t.move[:, 0] / 2, np.round(t.move[:, 0] / 2), atol=1e-9)
    assert abs(t.cv[-1, 0] - 9640.0) < 1000.0


def test_the_key_figures_are_those_of_the_run(mixed):
    t = mixed.trajectory
    choke = np.diff(t.mv[:, 0], prepend=50.0)
    deviation = np.abs(t.cv - t.setpoint).mean(axis=0)
    assert mixed.kpis["choke_travel"] == pytest.approx(np.abs(choke).sum())
    assert mixed.kpis["mean_absolute_deviation.gas_rate"] == pytest.approx(deviation[0])
    assert mixed.kpis["mean_absolute_deviation.oil_rate"] == pytest.approx(deviation[1])
    rows = shown_figures(mixed)
    assert len(rows) == len(explore.SHOWN)
    assert ("choke travel", "%", mixed.kpis["choke_travel"]) in rows


@pytest.mark.parametrize("name", ["continuous", "mixed"])
def test_the_first_planned_move_is_the_one_that_was_made(name, request):
    done = request.getfixturevalue(name)
    for sample in (0, 30, 179):
        plan = plan_at(done.data, RUN, 10.0 * sample)
        np.testing.assert_allclose(plan.move[0], done.trajectory.move[sample], atol=1e-6)
        np.testing.assert_allclose(plan.mv[0], done.trajectory.mv_demand[sample], atol=1e-6)
        assert plan.cv.shape == (250, 2)


@pytest.mark.parametrize("name", ["continuous", "mixed"])
def test_other_numbers_compile_nothing_again(name, request):
    controller = request.getfixturevalue(name).settings.controller
    compiled = []

    def heard(event, duration, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(heard)
    run(Settings(controller, choke_weight=100.0, oil_deadzone=1.0, oil_weight=0.2, soft=False, pressure=-1.0))
    run(Settings(controller, preset="no-soft-plain", oil_setpoint=140.0))
    assert compiled == []
    jax.jit(lambda x: x + len(compiled))(1.0)  # the ear is not deaf
    assert compiled


def test_progress_ends_with_all_samples():
    seen = []
    run(Settings(controller="continuous"), lambda done, total: seen.append((done, total)))
    assert seen[-1] == (180, 180)


def test_a_pressure_drop_costs_oil(continuous):
    dropped = run(Settings(controller="continuous", pressure=-4.0, pressure_time=0.0))
    assert dropped.kpis["oil_produced"] < continuous.kpis["oil_produced"]


def test_short_times_are_written_in_milliseconds_and_large_numbers_in_full():
    assert written(0.0123, "s") == ("12.3", "ms")
    assert written(1450.0, "s") == ("1,450", "s")
    assert written(123456.7, "m3") == ("123,457", "m³")
    assert written(3.0, "1") == ("3", "")


def test_the_script_prints_every_key_figure(capsys):
    main(["--controller", "continuous", "--choke-weight", "100", "--no-soft"])
    printed = capsys.readouterr().out
    for words in explore.SHOWN.values():
        assert words in printed


def test_the_script_explains_itself_and_refuses_bad_input(capsys):
    with pytest.raises(SystemExit) as left:
        main(["--help"])
    assert left.value.code == 0
    assert "[1/%^2]" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        main(["--choke-weight", "-1"])
    assert left.value.code == 2
    assert "move_weight" in capsys.readouterr().err


# --------------------------------------------------------------------------------------------------- figures


def test_a_run_is_drawn_beside_the_pinned_one(mixed, continuous):
    alone = draw.tracking(mixed.data)
    both = draw.tracking(mixed.data, pinned=continuous.data)
    assert [ax.get_ylabel() for ax in alone.axes] == [
        "oil rate [m³/h]",
        "gas rate [m³/h]",
        "choke [%]",
        "gas lift [m³/h]",
    ]
    oil = [line for line in both.axes[0].lines if line.get_label() == "pinned"]
    np.testing.assert_allclose(oil[0].get_ydata()[:180], continuous.trajectory.cv[:, 1])
    assert len(both.axes[0].lines) == len(alone.axes[0].lines) + 1
    assert draw.png(both).startswith(PNG)
    assert 'alt="a &quot;run&quot;"' in draw.image(alone, 'a "run"')


def test_the_plan_of_a_time_is_drawn_from_that_time_on(mixed):
    figure = draw.planned(mixed.data, 600.0)
    (plan,) = [line for line in figure.axes[0].lines if line.get_label() == "plan"]
    expected = plan_at(mixed.data, RUN, 600.0)
    np.testing.assert_allclose(plan.get_xdata() * 60, expected.cv_time)
    np.testing.assert_allclose(plan.get_ydata(), expected.cv[:, 1])
    assert draw.png(draw.planned(mixed.data, 0.0)).startswith(PNG)
    assert draw.png(draw.planned(mixed.data, 1790.0)).startswith(PNG)


def test_the_runs_of_a_sweep_become_points_with_what_varies_and_the_front(sweep):
    table = draw.points(sweep)
    expected = numbers(4)
    np.testing.assert_allclose(table[draw.X], expected["choke_travel"])
    zones = (1000.0, 5.0)
    np.testing.assert_allclose(table[draw.Y], (expected["mean_absolute_deviation"] / zones).mean(axis=1))
    assert table["number"].tolist() == [0, 1, 2, 3]
    assert table["best"][int(np.argmin(table[draw.X]))] == "on the front"
    assert all("250" in text for text in table["run"][1::2])


def test_a_stored_scenario_is_drawn_as_it_is_stored(sweep):
    data = draw.stored(sweep, 2)
    np.testing.assert_allclose(data.measurement.values[0], runs(4)["measurement"][2])
    assert data.tuning_deadzone.values.tolist() == [[1000.0, 5.0]]
    assert (data.kind.item(), data.actuator.item()) == ("continuous", "step")
    assert draw.png(draw.tracking(data, wide=True)).startswith(PNG)
    with pytest.raises(InputError, match="number"):
        draw.stored(sweep, 4)


def test_the_controllers_of_a_comparison_become_points_too(tmp_path):
    studies_synthetic.stored(tmp_path)
    table = draw.points(tmp_path)
    assert len(table) == 3
    data = draw.stored(tmp_path, 1)
    assert data.controller.values.tolist() == [RUN]
    assert list(data.mv.values).index(CHOKE) == 0
    assert draw.png(draw.tracking(data)).startswith(PNG)


def test_the_points_can_be_picked_from_a_chart(sweep):
    pytest.importorskip("altair")
    spec = draw.scatter(draw.points(sweep)).to_dict()
    assert spec["encoding"]["x"]["title"] == "choke travel [%]"
    assert {"number", "travel", "deviation", "best"} <= set(next(iter(spec["datasets"].values()))[0])


def test_what_is_no_store_is_refused(tmp_path):
    for path in (tmp_path / "none.zarr", tmp_path):
        with pytest.raises(InputError):
            draw.points(path)


# --------------------------------------------------------------------------------------------------- starting


def test_a_port_or_store_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(InputError, match="port"):
        launch.explore(0)
    with pytest.raises(InputError, match="store"):
        launch.explore(store=tmp_path / "none.zarr")


def test_a_missing_marimo_is_named_with_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingToolError, match=r"pip install 'jaxmpc\[notebook\]'"):
        launch.explore()


# ----------------------------------------------------------------------------------------------------- server


SERVED = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("marimo", "altair")),
    reason="not installed: marimo",
)


@contextlib.contextmanager
def serving(log, *options, **environment):
    """``jaxmpc explore`` in a process of its own: the process, and the address that it prints."""
    words = [sys.executable, "-m", "jaxmpc.cli", "explore", *map(str, options)]
    with open(log, "w") as errors:
        server = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=errors, text=True, env={**os.environ, **environment}
        )
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        assert line.startswith("jaxmpc: http://127.0.0.1:"), log.read_text()
        yield server, line.split()[1]
    finally:
        server.kill()
        server.communicate()


@pytest.fixture(scope="module")
def address(sweep, tmp_path_factory):
    with serving(tmp_path_factory.mktemp("server") / "log", "--headless", "--store", sweep) as (_, found):
        yield urlsplit(found)


def ask(address, path, method="GET", **headers):
    """Status, headers and body of an answer; a header that is None is left out."""
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=60)
    connection.putrequest(method, path, skip_host=True)
    for name, value in {"Host": address.netloc, **headers}.items():
        if value is not None:
            connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    with contextlib.closing(connection):
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def cookie_of(address):
    """What the browser of the user holds once it has opened the address."""
    status, headers, _ = ask(address, f"/?{address.query}")
    assert status == 200
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["Set-Cookie"].split("; "))
    return headers["Set-Cookie"].split(";")[0]


FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "https://127.0.0.1"},
    {"Host": "evil.example"},
    {"Host": None},
    {"Host": "127.0.0.1"},
    {"Host": "evil.example", "Origin": "http://evil.example"},
]
PATHS = ["/", "/auth/login", "/health", "/api/version", "/assets/", "/@file/x", "/openapi.json"]


@SERVED
@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_served_without_the_token(path, address):
    assert ask(address, path)[0] == 403
    assert ask(address, f"{path}?token=wrong")[0] == 403
    assert ask(address, f"{path}?access_token={address.query.partition('=')[2]}")[0] == 403
    assert ask(address, path, Cookie=cookie_of(address) + "x")[0] == 403


@SERVED
def test_what_browsers_ask_for_without_their_cookies_is_answered_and_says_nothing(address):
    status, _, body = ask(address, "/manifest.json")
    assert (status, json.loads(body)) == (200, {"name": "jaxmpc explore"})
    assert ask(address, "/manifest.json", Origin="http://evil.example")[0] == 403


@SERVED
@pytest.mark.parametrize("foreign", FOREIGN)
def test_a_page_of_another_site_is_refused_also_with_the_token(foreign, address):
    for path in ("/", "/api/kernel/set_ui_element_value"):
        for method in ("GET", "POST", "OPTIONS"):
            status, headers, body = ask(address, f"{path}?{address.query}", method, **foreign)
            assert status in (400, 403)  # a server may refuse a request without a host by itself
            assert len(body) < 200
            assert "Access-Control-Allow-Origin" not in headers


@SERVED
def test_controls_are_not_moved_without_the_token(address):
    path, own = "/api/kernel/set_ui_element_value", f"http://{address.netloc}"
    assert ask(address, path, "POST", Origin=own)[0] == 403
    cookie = cookie_of(address)
    assert ask(address, path, "POST", Cookie=cookie, Sec_Fetch_Site="same-site")[0] == 403
    assert ask(address, path, "POST", Cookie=cookie, Sec_Fetch_Site="same-origin", Origin=own)[0] != 403


@SERVED
def test_the_token_opens_the_app_and_the_cookie_keeps_it_open(address):
    status, _, body = ask(address, f"/?{address.query}")
    assert (status, b"jaxmpc explore" in body) == (200, True)
    named = address._replace(netloc=f"localhost:{address.port}")
    assert ask(named, f"/?{address.query}", Origin=f"http://localhost:{address.port}")[0] == 200
    status, headers, body = ask(address, "/", Cookie=cookie_of(address), Sec_Fetch_Site="none")
    assert (status, b"jaxmpc explore" in body) == (200, True)
    assert "Set-Cookie" not in headers


def listen(address, query, headers, origin=None, tries=3):
    """The first message of a WebSocket, or the status that refuses it; as a browser does, it connects again when dropped."""
    from websockets.exceptions import ConnectionClosedError, InvalidStatus
    from websockets.sync.client import connect

    uri = f"ws://127.0.0.1:{address.port}/ws?session_id=s_{os.urandom(4).hex()}{query}"
    host = headers.pop("Host", None)
    if host is not None:
        uri = uri.replace(f"127.0.0.1:{address.port}", host)
    with socket.create_connection(("127.0.0.1", address.port)) as connection:
        try:
            with connect(
                uri, sock=connection, origin=origin, additional_headers=headers, proxy=None
            ) as opened:
                return opened.recv(60)
        except InvalidStatus as refused:
            return refused.response.status_code
        except ConnectionClosedError:  # now and then, while the server ends the session before
            if tries == 1:
                raise
    return listen(address, query, {"Host": host, **headers} if host else headers, origin, tries - 1)


@SERVED
def test_a_websocket_is_refused_without_the_token_and_to_other_sites(address):
    pytest.importorskip("websockets")
    cookie, own, token = cookie_of(address), f"http://{address.netloc}", f"&{address.query}"
    assert listen(address, "", {}) == 403
    assert listen(address, "", {}, own) == 403
    assert listen(address, "&token=wrong", {}, own) == 403
    assert listen(address, "", {"Cookie": cookie}, "http://evil.example") == 403
    assert listen(address, token, {}, "http://evil.example") == 403
    assert listen(address, token, {"Host": f"evil.example:{address.port}"}) == 403
    assert listen(address, "", {"Cookie": cookie, "Sec-Fetch-Site": "same-site"}) == 403
    assert "kernel-ready" in listen(address, "", {"Cookie": cookie}, own)
    assert "kernel-ready" in listen(address, token, {})


SLOW = """
import time
from jax._src import compiler

def slowly(*arguments, real=compiler.backend_compile_and_load, waits=[1.3], **options):
    time.sleep(waits.pop() if waits else 0.0)
    return real(*arguments, **options)

compiler.backend_compile_and_load = slowly  # a machine that is slow with its first program
"""


@SERVED
def test_the_page_shows_that_programs_are_compiled_until_they_are(tmp_path):
    client = pytest.importorskip("websockets.sync.client")
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    found, more = os.environ.get("PYTHONPATH", ""), {"JAXMPC_QUIET": ""}
    with serving(tmp_path / "log", "--headless", PYTHONPATH=f"{tmp_path}{os.pathsep}{found}", **more) as (
        _,
        at,
    ):
        at = urlsplit(at)
        uri = f"ws://127.0.0.1:{at.port}/ws?session_id=s_{os.urandom(4).hex()}&{at.query}"
        shown, cell = [], None  # outputs of the cell that has said so
        with client.connect(uri, proxy=None, max_size=None) as page:
            while not shown or "compiling" in shown[-1]:
                said = json.loads(page.recv(300))
                output = said["data"].get("output") if said["op"] == "cell-op" else None
                if output and ("compiling" in output["data"] or said["data"]["cell_id"] == cell):
                    cell = said["data"]["cell_id"]
                    shown.append(output["data"])
    assert len(shown) == 2
    assert "compiling; once per machine" in shown[0]
    assert "compiling" not in shown[1]
    assert (tmp_path / "log").read_text() == ""


@SERVED
def test_the_app_is_served_on_the_loopback_interface_only_and_ends_with_its_process(tmp_path):
    for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM), (signal.SIGKILL, -9)):
        log = tmp_path / "log"
        with serving(log, "--headless") as (server, found):
            port = urlsplit(found).port
            with socket.socket() as elsewhere:
                elsewhere.bind(("127.0.0.2", port))  # of all interfaces it would be in use
            assert ask(urlsplit(found), "/")[0] == 403
            server.send_signal(number)
            assert server.wait(60) == status
            with socket.socket() as probe:
                assert probe.connect_ex(("127.0.0.1", port)) != 0
        assert log.read_text() == ("jaxmpc: stopped\n" if number == signal.SIGINT else "")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals as on POSIX")
@SERVED
@pytest.mark.parametrize("goes_on", [False, True], ids=["", "nohup"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["terminated", "killed"])
def test_the_server_ends_with_the_process_that_has_started_it_unless_it_is_told_to_go_on(
    number, goes_on, tmp_path
):
    ignoring = "trap '' HUP; " if goes_on else ""
    command = f'{ignoring}"{sys.executable}" -m jaxmpc.cli explore --headless & echo $!; wait'
    shell = subprocess.Popen(["sh", "-c", command], stdout=subprocess.PIPE, text=True, start_new_session=True)
    pid = int(shell.stdout.readline())
    try:
        port = urlsplit(shell.stdout.readline().split()[1]).port
        os.kill(shell.pid, number)  # this process alone
        shell.wait(60)
        if goes_on:
            time.sleep(3 * launch.LOOK)
            assert is_served(port)
        else:
            until(lambda: not is_served(port), 60)
            until(lambda: not is_running(pid), 60)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        shell.stdout.close()


def is_served(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")  # a container may have nobody who asks for the status of orphans
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals as on POSIX")
@SERVED
def test_the_server_ends_with_its_terminal_and_leaves_no_address_behind(tmp_path):
    import pty

    home, browser = tmp_path / "home", tmp_path / "browser"
    home.mkdir()
    browser.write_text("#!/bin/sh\nexec sleep 600\n")  # does not read its page
    browser.chmod(0o755)
    owns = "import fcntl, os, sys, termios; fcntl.ioctl(1, termios.TIOCSCTTY, 0); os.execv(sys.argv[1], sys.argv[1:])"
    terminal, inner = pty.openpty()
    server = subprocess.Popen(
        [sys.executable, "-c", owns, sys.executable, "-m", "jaxmpc.cli", "explore"],
        env={**os.environ, "HOME": str(home), "BROWSER": str(browser)},
        stdin=inner,
        stdout=inner,
        stderr=inner,
        start_new_session=True,
    )
    os.close(inner)
    said = b""
    while not said.endswith(b"\n"):
        said += os.read(terminal, 1000)
    port = urlsplit(said.decode().split()[1]).port
    until(lambda: list(home.glob("jaxmpc-*/open.html")))
    os.close(terminal)
    assert server.wait(60) == -signal.SIGHUP
    assert not is_served(port)
    assert list(home.glob("jaxmpc-*")) == []


@SERVED
def test_a_port_that_is_in_use_is_refused_before_anything_is_served(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert cli.main(["explore", "--headless", "--port", port]) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert port in captured.err


@SERVED
def test_the_browser_is_sent_to_the_address_which_no_argument_of_a_program_holds(tmp_path):
    seen, home = tmp_path / "seen", tmp_path / "home"
    home.mkdir()
    browser = tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho "$@" > "{seen}.part" && mv "{seen}.part" "{seen}"\n')
    browser.chmod(0o755)
    with serving(tmp_path / "log", HOME=str(home), BROWSER=str(browser)) as (server, found):
        until(seen.exists)
        page = Path(urlsplit(seen.read_text().strip()).path)
        assert html.escape(found) in page.read_text()
        assert page.parent.stat().st_mode & 0o077 == 0
        arguments = Path(f"/proc/{server.pid}/cmdline")
        shown = arguments.read_text() if arguments.exists() else ""
        assert urlsplit(found).query.partition("=")[2] not in seen.read_text() + shown
        assert ask(urlsplit(found), f"/?{urlsplit(found).query}")[0] == 200
        until(lambda: list(home.glob("jaxmpc-*")) == [])


def until(condition, seconds=300):
    """Wait for what is to be seen; a limit only for what never comes."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return found


# ---------------------------------------------------------------------------------------------------- browser


def _missing():
    tools = [tool for tool in ("chromium", "chromedriver") if shutil.which(tool) is None]
    modules = ("marimo", "altair", "selenium")
    return ", ".join(tools + [name for name in modules if importlib.util.find_spec(name) is None])


FIND = """
return [...document.querySelectorAll(arguments[0])].find(e => (e.dataset.label || '').includes(arguments[1])
  && e.shadowRoot && [...e.shadowRoot.querySelectorAll('*')].some(x => x.getBoundingClientRect().width > 0))
"""
SECOND_PAGE = """
[...document.querySelectorAll('marimo-radio')].flatMap(e => [...e.shadowRoot.querySelectorAll('[role=radio]')])
  .filter(e => e.getBoundingClientRect().width > 0)[1].click()
"""
POINTS = """
const chart = document.querySelector('marimo-vega');
return [...(chart?.shadowRoot?.querySelectorAll('.mark-symbol.role-mark path') || [])].map(e => {
  const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2] })
"""


class Page:
    """The app in a browser without a window."""

    def __init__(self, driver):
        self.driver, self.script = driver, driver.execute_script

    def figures(self):
        return self.script("return (document.querySelector('#key-figures') || {}).innerText || ''")

    def image(self, name):
        return self.script(
            "return (document.querySelector(`img[alt='${arguments[0]}']`) || {}).src || ''", name
        )

    def move_slider(self, label, key):
        thumb = self.script(
            "return arguments[0].shadowRoot.querySelector('[role=slider]')", self.find("slider", label)
        )
        self.script("arguments[0].focus()", thumb)
        thumb.send_keys(key)

    def press(self, label):
        self.script("arguments[0].shadowRoot.querySelector('button').click()", self.find("button", label))

    def find(self, kind, label):
        return until(lambda: self.script(FIND, f"marimo-{kind}", label))


@pytest.fixture
def page(address):
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,943"):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.get(address.geturl())
        yield Page(driver)
    finally:
        driver.quit()


@pytest.mark.skipif(bool(_missing()), reason=f"not installed: {_missing()}")
def test_in_a_browser_a_slider_changes_figure_and_key_figures_and_a_point_shows_its_run(page, tmp_path):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    until(lambda: page.figures() and page.image("the run") and page.image("the plan"))
    before, drawn, planned = page.figures(), page.image("the run"), page.image("the plan")
    page.press("Pin this run")
    until(lambda: "pinned" in page.figures())
    until(lambda: page.image("the run") != drawn)
    pinned, drawn = page.figures(), page.image("the run")
    page.move_slider("oil deadzone", Keys.HOME)
    until(lambda: page.figures() != pinned and page.image("the run") != drawn)
    until(lambda: page.image("the plan") != planned)
    travel = before.splitlines()[1].split("\t")[1]
    assert page.figures().splitlines()[1].split("\t")[2] == travel  # the pinned run stays
    planned, run_before = page.image("the plan"), page.image("the run")
    page.move_slider("plan made at", Keys.ARROW_RIGHT)
    until(lambda: page.image("the plan") != planned)
    assert page.image("the run") == run_before
    page.driver.save_screenshot(str(tmp_path / "run.png"))

    page.script(SECOND_PAGE)
    at = until(lambda: page.script(POINTS))
    assert len(at) == 4
    ActionChains(page.driver).move_by_offset(*map(int, at[0])).click().perform()
    until(lambda: page.image("the picked run"))
    page.driver.save_screenshot(str(tmp_path / "study.png"))
    wrong = [entry["message"] for entry in page.driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert "\n".join(wrong) == ""


@pytest.mark.skipif(importlib.util.find_spec("marimo") is None, reason="not installed: marimo")
def test_the_app_is_a_script_too():
    words = [sys.executable, "-m", "studies.notebooks.explore", "--help"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    assert "--oil-deadzone" in done.stdout
