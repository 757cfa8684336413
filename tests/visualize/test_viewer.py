"""The viewer: its state under controls, its pace, its shapes, and a page that only this machine can open."""

import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import psutil
import pytest

from hasrl_jax.cli import viewer
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.policy import loading as policies
from hasrl_jax.runs import checkpoint
from hasrl_jax.visualize.viewer import browser, guard, native
from hasrl_jax.visualize.viewer.live import MAX_BEHIND_S, Controls, Live, Pace, Push, readout
from hasrl_jax.visualize.viewer.shapes import shapes

SMALL = {"network": {"hidden_size": 8}}


@pytest.fixture(scope="module")
def live() -> Live:
    config = from_dict(SMALL)
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    return Live(config, ppo.export_parameters(learner), seed=0)


def test_commands_reach_the_policy_at_once(live: Live) -> None:
    live.advance(Controls((0.4, -0.1), reset=True))
    assert live.view().measures["forward_command"] == pytest.approx(0.4)
    live.advance(Controls((0.7,)))
    measures = live.view().measures
    assert (measures["forward_command"], measures["lateral_command"]) == (pytest.approx(0.7), 0.0)
    assert live.view().time_s == pytest.approx(2 * live.step_s)


def test_pausing_stops_time_but_a_reset_still_acts(live: Live) -> None:
    live.advance(Controls(reset=True))
    before = live.view()
    live.advance(Controls(paused=True))
    np.testing.assert_array_equal(live.view().qpos, before.qpos)
    assert live.view().time_s == before.time_s > 0
    live.advance(Controls(paused=True, reset=True, randomized=True))
    assert live.view().time_s == 0
    assert live.view().randomized


def test_a_push_is_that_of_the_task_and_ends(live: Live) -> None:
    def play(push: Push | None) -> list[np.ndarray]:
        live._episode.player.env.reset(seed=1)
        live.advance(Controls(reset=True))
        live.advance(Controls(push=push))
        seen = [live.view().qpos]
        for _ in range(8):
            assert (live.view().push is None) == (push is None)
            live.advance(Controls())
            seen.append(live.view().qpos)
        assert live.view().push is None
        return seen

    env = live._episode.player.env
    alone, pushed = play(None), play(Push(80.0, 90.0))
    np.testing.assert_allclose(env._state.task.push, [0.0, 0.0], atol=1e-9)  # it is over
    assert pushed[-1][1] - alone[-1][1] > 0.02  # to the left
    live.advance(Controls(reset=True, push=Push(80.0, 90.0)))
    np.testing.assert_allclose(live._episode.player.env._state.task.push, [0.0, 80.0], atol=1e-9)


def test_a_push_to_the_left_is_to_the_left_of_a_robot_that_has_turned(live: Live) -> None:
    live.advance(Controls(reset=True))
    env = live._episode.player.env
    physics = env._state.physics.copy()
    physics[4:8] = [np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)]  # a quarter to the left: it faces along y
    env._state = env._shown = env._state._replace(physics=physics)
    live.advance(Controls(push=Push(80.0, 90.0)))
    np.testing.assert_allclose(env._state.task.push, [-80.0, 0.0], atol=1e-9)
    assert live.view().push == Push(80.0, pytest.approx(180.0))


def test_falls_begin_another_episode_and_are_counted(live: Live) -> None:
    live.advance(Controls(reset=True))
    before = live.view().falls
    for _ in range(400):  # the parameters are random: it cannot walk
        live.advance(Controls((1.0,), randomized=True))
        if live.view().falls > before:
            break
    assert live.view().falls == before + 1
    assert live.view().randomized
    assert live.view().time_s == 0
    assert dict(readout(live.view(), live.commands, 1.0))["falls"] == f"{before + 1}, last end: fell"


def test_a_randomized_robot_has_steps_of_its_own(live: Live) -> None:
    live.advance(Controls(reset=True))
    assert live.step_s == pytest.approx(0.025)
    durations = set()
    for _ in range(3):
        live.advance(Controls(reset=True, randomized=True))
        durations.add(live.step_s)
    assert len(durations) == 3
    assert all(0.6 * 0.025 <= duration <= 1.2 * 0.025 for duration in durations)


def test_poses_are_those_of_the_robot(live: Live) -> None:
    live.advance(Controls((0.3,), reset=True))
    view = live.view()
    np.testing.assert_allclose(view.position[1], view.qpos[:3])
    np.testing.assert_allclose(view.orientation[1], view.qpos[3:7], atol=1e-9)


def test_any_task_is_shown() -> None:
    config = from_dict(SMALL | {"task": "cartpole"})
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    live = Live(config, ppo.export_parameters(learner), seed=0, randomized=True)
    live.advance(Controls(randomized=True))
    assert (live.commands, live.can_push, live.can_randomize, live.view().randomized) == ((), False, False, False)
    rows = dict(readout(live.view(), live.commands, 1.0))
    number, unit = rows["angle"].split()
    assert (float(number), unit) == (pytest.approx(live.view().measures["angle"], abs=0.01), "rad")


def test_the_ground_of_an_episode_is_shown() -> None:
    stairs = {"kind": "steps", "step_height_m": [0.1, 0.1], "step_depth_m": [0.4, 0.4]}
    config = from_dict(SMALL | {"cassie": {"terrain": stairs}})
    task = make_task(config)
    learner = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    live = Live(config, ppo.export_parameters(learner), seed=0)
    live.view()
    boxes = np.flatnonzero((live.model.geom_bodyid == 0) & (live.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX))
    top = live.model.geom_pos[boxes, 2] + live.model.geom_size[boxes, 2]
    np.testing.assert_allclose(np.diff(top)[:8], 0.1, atol=1e-9)
    np.testing.assert_allclose(live.model.geom_size[boxes[1:9], 0], 0.2, atol=1e-9)


def test_pace_waits_for_the_clock_and_gives_up_what_it_missed() -> None:
    now = [100.0]
    pace = Pace(lambda: now[0])
    assert pace.wait_s(0.025) == pytest.approx(0.025)
    now[0] += 0.025
    assert pace.wait_s(0.025) == pytest.approx(0.025)
    assert pace.share() == pytest.approx(2.0)  # two steps within one step's time, so far
    for _ in range(60):  # each step takes twice its time
        now[0] += 0.05
        assert pace.wait_s(0.025) < 1e-9
    assert pace.share() == pytest.approx(0.5, abs=0.02)
    waits = 0
    while pace.wait_s(0.025) == 0:
        waits += 1
    assert waits <= MAX_BEHIND_S / 0.025  # it does not race to catch up with 1.5 s


def test_the_readout_says_when_it_is_behind(live: Live) -> None:
    live.advance(Controls((0.4,), reset=True))
    rows = dict(readout(live.view(), live.commands, 0.5))
    assert rows["pace"] == "behind: 50% of real time"
    assert rows["forward"].endswith("of +0.40 m/s")
    assert dict(readout(live.view(), live.commands, 1.0))["pace"] == "real time"


def test_nothing_is_minus_zero(live: Live) -> None:
    view = live.view()
    zeros = view._replace(measures=dict.fromkeys(view.measures, -1e-4))
    rows = dict(readout(zeros, live.commands, 1.0))
    assert rows["forward"] == "+0.00 of +0.00 m/s"
    assert rows["height"] == "+0.00 m"


def test_shapes_have_the_size_that_mujoco_gives_them(live: Live) -> None:
    pytest.importorskip("trimesh")
    drawn = shapes(live.model)
    assert len(drawn) > 40
    for shape in drawn:
        aabb = live.model.geom_aabb[int(shape.name.removeprefix("geom-"))]
        extent = np.abs(shape.vertices).max(axis=0)
        np.testing.assert_allclose(extent, aabb[3:], rtol=0.02, atol=1e-6, err_msg=shape.name)
        np.testing.assert_allclose(shape.vertices.min(axis=0), -shape.vertices.max(axis=0), rtol=0.02, atol=1e-6)


def test_keys_of_the_native_window() -> None:
    keys = native.Keys(make_task(from_dict({})).commands, randomized=True)
    for key in (native.UP, native.UP, native.LEFT, native.SPACE, native.ENTER, 65):
        keys.press(key)
    first = keys.controls()
    assert first == Controls((0.2, 0.05), paused=True, randomized=True, push=Push(native.PUSH_N, 90.0))
    assert keys.controls() == first._replace(push=None)
    for key in (native.SPACE, native.BACKSPACE, native.ENTER, native.DOWN):
        keys.press(key)
    second = keys.controls()
    assert second == Controls((0.1, 0.05), randomized=True, reset=True, push=Push(native.PUSH_N, -90.0))


def test_the_page_is_open_to_this_machine_only(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0, randomized=True)
    try:
        port = int(page.url.rpartition(":")[2])
        listening = [c.laddr for c in psutil.Process().net_connections() if c.status == psutil.CONN_LISTEN]
        assert [address.ip for address in listening if address.port == port] == ["127.0.0.1"]
        with urllib.request.urlopen(page.url, timeout=10) as answer:
            assert answer.status == 200
        with pytest.raises(ConfigError, match=f"--port: got {port}"):
            browser.free_port(port)
        with pytest.raises(ConfigError, match=r"--host: got nowhere\.invalid, which is no address of this machine"):
            browser.free_port(port, "nowhere.invalid")

        steps = iter(range(20))
        live.advance(Controls(reset=True))
        page._sliders[0].value = 0.5
        viewer.loop(live, page, Pace(), lambda: next(steps, None) is None)
        view = live.view()
        assert view.time_s == pytest.approx(21 * 0.025)
        assert view.measures["forward_command"] == pytest.approx(0.5)
        np.testing.assert_allclose(page._bodies[1].position, view.position[1])
        np.testing.assert_allclose(page._world.position[:2], -view.position[1, :2])  # the camera follows
        assert "| time |" in page._readout.content
        assert page.controls() == Controls((0.5, 0.0), randomized=True)
        page._push = True
        assert page.controls().push == Push(60.0, 90.0)
        assert page.controls().push is None
    finally:
        page.close()
    assert browser.free_port(port) == port  # nothing listens any more


def test_a_phone_shows_what_one_touches_before_what_one_reads(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0)
    try:
        touched = [slider.order for slider in page._sliders] + [page._push_button.order, page._force.order]
        assert touched == sorted(touched) and touched[-1] < page._readout.order < page._paused.order
    finally:
        page.close()


def test_what_is_typed_beyond_the_ends_of_a_slider_counts_as_its_ends(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0)
    try:
        for slider, typed in ((page._sliders[0], 40.0), (page._sliders[1], -40.0), (page._force, 4000.0)):
            slider.value = typed
        page._push = True
        forward, lateral = live.commands
        controls = page.controls()
        assert controls.command == (forward.drawn[1], lateral.drawn[0])
        assert controls.push == Push(browser.PUSH_N[1], 90.0)
    finally:
        page.close()


def _get(url: str, **headers: str) -> tuple[int, str, dict[str, str]]:
    """(status, text, headers) of a request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
            return answer.status, answer.read().decode(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), dict(error.headers)


def _moves_sliders(page: browser.Browser, url: str, **headers: str) -> bool:
    """Whether a websocket with these headers may set the first slider."""
    import msgspec
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    page._sliders[0].value = 0.0
    slider = page._sliders[0]._impl.uuid
    message = {"type": "GuiUpdateMessage", "uuid": slider, "updates": {"value": 0.75}}
    try:
        with connect(
            url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], additional_headers=headers
        ) as connection:
            connection.recv(timeout=10)
            connection.send(msgspec.msgpack.encode(message))
            ended = time.monotonic() + 5
            while page._sliders[0].value == 0.0 and time.monotonic() < ended:
                time.sleep(0.01)
    except InvalidStatus as refused:
        return refused.response.status_code != 403
    return page._sliders[0].value == 0.75


def test_no_page_of_another_site_is_answered(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0)
    try:
        port = page.url.rpartition(":")[2]
        for host in (f"127.0.0.1:{port}", f"localhost:{port}", "LOCALHOST:9", "[::1]:80", "localhost"):
            assert _get(page.url, Host=host)[0] == 200, host
        for host in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "", "127.0.0.1.evil.example:80"):
            status, text, _ = _get(page.url, Host=host)
            assert (status, text) == (403, "the viewer answers to localhost only\n"), host
        assert _get(page.url, Origin=page.url)[0] == 200
        for origin in ("http://evil.example", "null", f"https://127.0.0.1:{port}", "http://127.0.0.1:9", ""):
            assert _get(page.url, Origin=origin)[0] == 403, origin
        assert _get(page.url)[2]["X-Frame-Options"] == "DENY"
        assert _moves_sliders(page, page.url, Origin=page.url)
        assert not _moves_sliders(page, page.url, Origin="http://evil.example")
        assert not _moves_sliders(page, page.url, Host="evil.example", Origin="http://evil.example")
    finally:
        page.close()


def test_beyond_this_machine_a_token_is_asked_for(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0, host=browser.ANY_HOST)
    try:
        address, _, token = page.url.partition("/?token=")
        assert len(token) == 32
        here = f"http://127.0.0.1:{address.rpartition(':')[2]}"
        for query, cookie in (
            ("", ""),
            ("/?token=", ""),
            ("/?token=x", ""),
            ("", "hasrl_viewer=x"),
            ("", f"x={token}"),
        ):
            assert _get(here + query, Cookie=cookie)[0] == 403
        status, _, headers = _get(f"{here}/?token={token}")
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert (status, cookie) == (200, f"hasrl_viewer={token}")
        assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
        assert _get(here, Cookie=f"a=b; {cookie}", Host="robots.example:80")[0] == 200
        assert _moves_sliders(page, here, Origin=here, Cookie=cookie)
        assert not _moves_sliders(page, here, Origin=here)
        assert not _moves_sliders(page, here, Origin="http://evil.example", Cookie=cookie)
    finally:
        page.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost", "0.0.0.0", "::", "192.168.1.2", "x"])
def test_what_only_this_machine_can_reach(host: str) -> None:
    assert guard.is_loopback(host) == (host.startswith("127.") or host in ("::1", "localhost"))


def test_a_server_that_is_not_guarded_is_refused() -> None:
    with pytest.raises(ConfigError, match="viser"), guard.guarded(None):
        pass


def test_without_viser_one_line_says_what_to_install(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, path = from_dict(SMALL), tmp_path / "policy.npz"
    checkpoint.save_policy(path, live._episode.player._policy.parameters, policies.policy_metadata(config))
    monkeypatch.setitem(sys.modules, "viser", None)
    assert viewer.main(["--policy", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "hasrl_jax[viewer]" in error
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    assert viewer.main(["--policy", str(path), "--native"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "DISPLAY" in error


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--port", "70000"], "--port"),
        (["--seed", "-1"], "--seed"),
        (["--port", "x"], "--port: got 'x'; expected a whole number"),
        (["--physics", "fast"], "--physics: got 'fast'; expected one of paper, training"),
        (["--policy"], "--policy: missing; expected a value"),
        (["--prt", "1"], "--prt"),
        (["--host", "no.such.host.invalid"], "no.such.host.invalid"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str], named: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(browser, "require_viser", lambda: None)
    try:
        status = viewer.main(arguments)
    except SystemExit as stopped:
        status = stopped.code
    error = capsys.readouterr().err
    assert status == 2
    assert named in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("aspect", "share"), [(0.5, 0.4), (1.6, 0.75)])
def test_the_robot_stands_above_the_panel_of_a_narrow_window(aspect: float, share: float) -> None:
    """Its pelvis and feet are projected by hand: 0 is the upper edge of the window, 1 the lower one."""
    position, target = (np.array(point) for point in browser.camera(aspect))
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    up = np.cross(right / np.linalg.norm(right), ahead)
    for point in ([0.0, 0.0, 1.1], [0.0, 0.0, 0.0]):
        seen = np.array(point) - position
        height = 0.5 - 0.5 * (seen @ up) / (seen @ ahead) / np.tan(np.deg2rad(75.0) / 2)  # the page's field of view
        assert 0.05 < height < share


def test_every_visitor_gets_the_camera_of_the_window() -> None:
    for aspect in (0.5, 1.6):
        client = SimpleNamespace(camera=SimpleNamespace(aspect=aspect, position=None, look_at=None))
        browser._place_camera(client)  # type: ignore[arg-type]
        assert (client.camera.position, client.camera.look_at) == browser.camera(aspect)


def test_the_arrow_of_a_push_stays_for_a_moment(live: Live) -> None:
    pytest.importorskip("viser")
    page = browser.Browser(live, port=0)
    try:
        live.advance(Controls(reset=True, push=Push(80.0, 90.0)))
        seen = []
        for _ in range(60):
            page.show(live.view(), 1.0)
            seen.append(page._arrow.visible)
            live.advance(Controls())
        assert 25 <= sum(seen) <= 40 and seen[0] and not seen[-1]  # 8 environment steps, and 24 more
    finally:
        page.close()
