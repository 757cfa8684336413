"""The gait library: its curves, mirror images, what lies between gaits, and the states that episodes begin in."""

import hashlib
import json
from functools import partial
from math import comb
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.config.checks import check
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import frames
from hasrl_jax.envs.cassie import bezier, gaits
from hasrl_jax.envs.cassie.ids import cassie_ids
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError

LIBRARY = gaits.load(gaits.USUAL)
HEADING = {"frame": "heading", "start_heading_rad": 3.0, "height_m": [0.8, 0.9], "resample_s": [0, 0]}


def _config(**reference: object) -> Config:
    """The walking recipe with a reference."""
    settings = {"gaits": gaits.USUAL} | reference
    return from_dict({"cassie": {"reference": settings, "randomize": {"enabled": False}}}, shipped("cassie_walk"))


def _de_casteljau(points: np.ndarray, u: float) -> float:
    while len(points) > 1:
        points = (1 - u) * points[:-1] + u * points[1:]
    return float(points[0])


@pytest.mark.parametrize("phase", [0.0, 0.13, 0.4999, 0.5, 0.77, 0.999])
def test_a_curve_is_that_of_de_casteljau(phase: float) -> None:
    coefficients = np.random.default_rng(0).normal(size=(2, 3, 6))
    half, u = int(phase >= 0.5), 2 * phase % 1
    expected = [_de_casteljau(coefficients[half, curve], u) for curve in range(3)]
    for xp in (np, jnp):
        found = bezier.value(xp.asarray(coefficients), xp.asarray(phase), xp)
        np.testing.assert_allclose(found, expected, atol=1e-5 if xp is jnp else 1e-12)


def test_a_fit_finds_what_the_curves_can_express_and_joins_the_halves() -> None:
    phase = np.arange(40) / 40
    samples = np.stack([np.full(40, 0.7), np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)], axis=1)
    coefficients = bezier.fit(samples, phase)
    np.testing.assert_allclose(bezier.value(coefficients[None], phase, np), samples, atol=2e-3)
    rough = bezier.fit(np.random.default_rng(1).normal(size=(40, 2)), phase)
    for end, begin in ((0, 1), (1, 0)):
        np.testing.assert_allclose(rough[end, :, 5], rough[begin, :, 0])
        slopes = rough[end, :, 5] - rough[end, :, 4], rough[begin, :, 1] - rough[begin, :, 0]
        np.testing.assert_allclose(*slopes)


@pytest.mark.parametrize("source", gaits.PACKAGED)
def test_the_file_is_the_one_that_is_pinned(source: str) -> None:
    path, sha256 = gaits.PACKAGED[source]
    assert hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    assert path.stat().st_size < 600_000


def test_every_gait_walks_as_fast_and_high_as_its_place_says() -> None:
    """By the states alone: the mean velocity of the pelvis and its mean height over a cycle."""
    cells = np.stack(np.meshgrid(*(getattr(LIBRARY, name) for name in gaits.AXES), indexing="ij"), axis=-1)
    pelvis = LIBRARY.states[..., [gaits.QPOS_SIZE, gaits.QPOS_SIZE + 1, 2]].mean(axis=-2)
    off = np.abs(pelvis - cells)
    # 2.5 m/s with nearly straight legs is more than the policy walks.
    assert off[-1, :, -1].max() < 0.35
    off[-1, :, -1] = 0.0
    assert off.max() < 0.1
    assert off.mean() < 0.015


def test_the_fast_gaits_walk_as_their_places_say_but_lower_at_speed() -> None:
    fast = gaits.load(gaits.FAST)
    assert fast.bounds == {"forward_m_s": (-1.0, 4.0), "lateral_m_s": (-0.5, 0.5), "height_m": (0.65, 1.0)}
    forward, lateral, height = np.moveaxis(fast.states[..., [35, 36, 2]].mean(axis=-2), -1, 0)
    off_forward = np.abs(forward - fast.forward_m_s[:, None, None])
    off_lateral = np.abs(lateral - fast.lateral_m_s[:, None])
    assert off_forward.mean() < 0.05
    assert off_lateral.mean() < 0.02
    straight = off_forward[:, 1]
    assert straight[:-1].max() < 0.07
    assert straight[-1].max() < 0.15  # 4 m/s is more than the policy walks
    walking = (fast.forward_m_s >= 0.0) & (fast.forward_m_s <= 1.5)
    assert np.abs(height[walking] - fast.height_m).max() < 0.03
    np.testing.assert_allclose(height[-1], 0.81, atol=0.02)
    np.testing.assert_allclose(fast.cycle_s, 0.75 - 0.075 * np.maximum(fast.forward_m_s - 2.0, 0.0), atol=1e-6)


@pytest.mark.parametrize(("source", "mean", "most"), [(gaits.USUAL, 0.03, 0.3), (gaits.FAST, 0.05, 0.5)])
def test_curves_are_the_recorded_motion(source: str, mean: float, most: float) -> None:
    """The fast ones differ more from cycle to cycle, and their states are up to half a step off their phase."""
    library = gaits.load(source)
    ids = cassie_ids(make_task(_config()).model)
    count = library.states.shape[3]
    phase = np.arange(count) / count
    off = []
    for cell in np.ndindex(library.states.shape[:3]):
        curves = bezier.value(library.curves[cell][None], phase, np)
        off.append(curves[:, gaits.PLACES["motor_positions"]] - library.states[cell][:, ids.motor_qpos])
    assert np.sqrt(np.mean(np.square(off))) < mean
    assert np.abs(off).max() < most


@pytest.mark.parametrize("source", gaits.PACKAGED)
def test_joints_move_along_the_curves_as_fast_as_the_cycle_says(source: str) -> None:
    """The recorded joint velocities by the slope of the curves over time, at every forward speed.

    Less than 1, since motors jerk from target to target and are often slower at the moment of a recording.
    """
    library = gaits.load(source)
    ids = cassie_ids(make_task(_config()).model)
    count, small = library.states.shape[3], 1e-4
    phase = np.arange(count) / count
    motors = gaits.PLACES["motor_positions"]
    for forward, cycle_s in enumerate(library.cycle_s):
        slopes, recorded = [], []
        for cell in np.ndindex(library.states.shape[1:3]):
            curve = library.curves[(forward, *cell)][None]
            ends = [bezier.value(curve, np.mod(phase + step, 1.0), np)[:, motors] for step in (-small, small)]
            slopes.append((ends[1] - ends[0]) / (2 * small * cycle_s))
            recorded.append(library.states[(forward, *cell)][:, gaits.QPOS_SIZE + ids.motor_qvel])
        a, b = np.ravel(slopes), np.ravel(recorded)
        assert 0.75 < a @ b / (a @ a) < 1.0, library.forward_m_s[forward]


def test_the_mirror_image_of_a_gait_is_the_one_to_the_other_side_half_a_cycle_later() -> None:
    half = LIBRARY.states.shape[3] // 2
    model = make_task(_config()).model
    left, right = LIBRARY.states[3, -1, 1], LIBRARY.states[3, 0, 1]
    assert LIBRARY.lateral_m_s[-1] == -LIBRARY.lateral_m_s[0] > 0
    for ours, theirs in ((left[4], right[4 + half]), (left[half + 2], right[2])):
        feet = []
        for state in (ours, theirs):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
            mujoco.mj_forward(model, data)
            feet.append([data.body(name).xpos.copy() for name in ("left-foot", "right-foot", "cassie-pelvis")])
        # The pelvis is not symmetric to the last millimetre, and nothing else is in the way.
        np.testing.assert_allclose(np.array(feet[0]) * [1, -1, 1], np.array(feet[1])[[1, 0, 2]], atol=1e-6)
    np.testing.assert_allclose(gaits.mirrored(gaits.mirrored(left, gaits.STATE), gaits.STATE), left)
    straight = LIBRARY.curves[:, len(LIBRARY.lateral_m_s) // 2]
    np.testing.assert_allclose(gaits.mirrored_curves(straight), straight, atol=1e-6)


def _motion(forward: float, lateral: float, height: float, phase: float, standing: bool = False) -> np.ndarray:
    told = np.array(forward), np.array(lateral), np.array(height)
    found = gaits.motion(LIBRARY, told, np.array(phase), np.array(standing), np)
    return np.concatenate([found[entry.name] for entry in gaits.MOTION])


def test_between_gaits_the_motion_is_shared_by_distance_and_outside_it_is_that_of_the_edge() -> None:
    f, h = LIBRARY.forward_m_s, LIBRARY.height_m
    at = [_motion(f[2], 0.0, h[0], 0.3), _motion(f[3], 0.0, h[0], 0.3)]
    middle = len(LIBRARY.lateral_m_s) // 2
    np.testing.assert_allclose(at[0], bezier.value(LIBRARY.curves[2, middle, 0], np.array(0.3), np), atol=1e-12)
    np.testing.assert_allclose(_motion(0.75 * f[2] + 0.25 * f[3], 0.0, h[0], 0.3), 0.75 * at[0] + 0.25 * at[1])
    np.testing.assert_allclose(_motion(99.0, 0.0, h[0] - 1, 0.3), _motion(f[-1], 0.0, h[0], 0.3))
    corners = [_motion(f[1], y, z, 0.8) for y in LIBRARY.lateral_m_s[-2:] for z in h[:2]]
    np.testing.assert_allclose(
        _motion(f[1], LIBRARY.lateral_m_s[-2:].mean(), h[:2].mean(), 0.8), np.mean(corners, axis=0), atol=1e-12
    )
    np.testing.assert_allclose(_motion(0.0, 0.0, h[1], 0.3, True), LIBRARY.standing[1])


def _closure_m(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """The widest opening of a leg's loops."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rows = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert rows.sum() == 12
    return float(np.abs(data.efc_pos[: data.nefc][rows]).max())


def test_states_keep_the_loops_of_the_legs_closed() -> None:
    model = make_task(_config()).model
    every = LIBRARY.states[::3, :, ::2, ::7].reshape(-1, LIBRARY.states.shape[-1])
    widest = [_closure_m(model, state[: model.nq]) for state in [*every, *LIBRARY.standing_states]]
    # Under load they are springs, see test_cassie_model; a foot that lands at 2.5 m/s opens them furthest.
    assert max(widest) < 0.012
    assert np.quantile(widest, 0.9) < 0.007
    stretched = every[0][: model.nq].copy()
    stretched[cassie_ids(model).passive_qpos[0]] += 0.2
    assert _closure_m(model, stretched) > 0.05


@pytest.mark.parametrize("frame", ["world", "heading"])
def test_a_share_of_episodes_begins_in_the_gait_of_its_command(frame: str) -> None:
    command = HEADING if frame == "heading" else {"frame": "world"}
    ranges = {"forward_m_s": [-0.5, 2.4], "lateral_m_s": [-0.3, 0.3], "stand_probability": 0.2, "start_moving": 0.0}
    config = from_dict({"cassie": {"command": ranges | command}}, _config(start_share=0.7))
    task = make_task(config)
    fresh = task.reset(np.random.default_rng(0).random((300, task.reset_uniforms)), np)
    begun = ~np.isclose(fresh.qpos[:, 7], 0.0045)  # not in the initial pose
    assert 0.6 < begun.mean() < 0.8
    assert not fresh.qvel[~begun].any()
    yaw = fresh.state.target_heading
    if frame == "heading":
        assert np.abs(yaw).max() > 2
    told = fresh.state.command
    height = told[:, 3] if frame == "heading" else np.full(300, 0.9)
    at_rest = (told[:, :3] == 0).all(axis=1) & (frame == "heading")
    assert 0.1 < at_rest[begun].mean() < 0.3 or frame == "world"
    count = LIBRARY.states.shape[3]
    for robot in np.flatnonzero(begun):
        cell = tuple(
            int(np.abs(getattr(LIBRARY, name) - value).argmin())
            for name, value in zip(gaits.AXES, (*told[robot, :2], height[robot]), strict=True)
        )
        index = round(fresh.state.phase[robot] * count)
        expected = LIBRARY.states[cell][index % count]
        if at_rest[robot]:
            expected = LIBRARY.standing_states[cell[2]]
            assert fresh.state.standing[robot]
        np.testing.assert_allclose(fresh.qpos[robot, 7:], expected[7:35])
        np.testing.assert_allclose(fresh.qvel[robot, 3:], expected[38:])
        seen = frames.turned_quaternion(fresh.qpos[robot, 3:7], -yaw[robot], np)
        np.testing.assert_allclose(np.abs(seen @ expected[3:7]), 1.0, atol=1e-6)
        np.testing.assert_allclose(np.hypot(*fresh.qvel[robot, :2]), np.hypot(*expected[35:37]))
        forward = fresh.qvel[robot, 0] * np.cos(yaw[robot]) + fresh.qvel[robot, 1] * np.sin(yaw[robot])
        np.testing.assert_allclose(forward, expected[35], atol=1e-9)
    places = fresh.state.phase[begun & ~at_rest] * count
    np.testing.assert_allclose(places, np.round(places), atol=1e-9)
    assert len(set(np.round(places))) > 15


def test_a_robot_that_begins_in_a_gait_goes_on_where_one_in_the_initial_pose_does_not_move() -> None:
    """For a quarter of a second, with no policy but targets at the recorded joints."""
    speeds, command = [], {"forward_m_s": [1.0, 1.0], "lateral_m_s": [0, 0], "stand_probability": 0, "start_moving": 0}
    for share in (1.0, 0.0):
        config = from_dict({"cassie": {"command": command}}, _config(start_share=share, residual=True))
        envs, rng = CpuEnvs(make_task(config), 8, 1000), np.random.default_rng(0)
        state = envs.reset(rng)
        for _ in range(10):
            state, result = envs.step(state, np.zeros((8, 10)), rng)
        speeds.append(result.measures[:, envs.task.measures.index("forward_speed")])
    assert speeds[0].min() > 0.5
    assert speeds[1].max() < 0.3


def test_numpy_and_jax_begin_and_move_alike() -> None:
    config = from_dict({"cassie": {"command": HEADING}}, _config(start_share=0.8, residual=True))
    task = make_task(config)
    uniforms = np.random.default_rng(2).random((16, task.reset_uniforms))
    ours, theirs = task.reset(uniforms, np), jax.jit(partial(task.reset, xp=jnp))(uniforms)
    for name in ("qpos", "qvel", "observation"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=2e-5, err_msg=name)
    actions = np.random.default_rng(3).uniform(-1, 1, (16, 10))
    targets = jax.jit(partial(task.control, xp=jnp))(theirs.state, actions)
    np.testing.assert_allclose(targets, task.control(ours.state, actions, np), atol=2e-5)


def test_a_residual_action_is_added_to_the_reference_of_the_end_of_the_step() -> None:
    config = from_dict(
        {"cassie": {"command": {"forward_m_s": [0.5, 0.5], "lateral_m_s": [0, 0], "stand_probability": 0.0}}},
        _config(residual=True),
    )
    task = make_task(config)
    fresh = task.reset(np.full((1, task.reset_uniforms), 0.25), np)
    action = np.full((1, 10), 0.1)
    expected = _motion(0.5, 0.0, 0.9, 0.25 + 0.025 / 0.75)[:10] + 0.1
    np.testing.assert_allclose(task.control(fresh.state, action, np)[0], expected)
    assert {c.name: tuple(c.limits) for c in task.commands}["forward"] == (-0.5, 2.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"reference": {"gaits": ""}},
            r"reference\.gaits: got ''; expected library, library_fast, or .*start_share needs one",
        ),
        ({"reference": {"gaits": "nowhere.npz"}}, r"gaits: got 'nowhere.npz', which does not exist; expected library"),
        ({"reference": {"min_reward": 0.3}}, r"cassie\.reference\.min_reward: got 0\.3; expected 0 where no term of"),
        (
            {"clock": {"cycle_s": 0.8}},
            r"cassie\.clock\.cycle_s: got 0\.8; expected what makes a cycle of 0\.75 s at \S+ m/s",
        ),
        (
            {"clock": {"cycle_per_speed_s": -0.1}},
            r"cassie\.clock\.cycle_per_speed_s: got -0\.1; expected what makes a cycle of 0\.75 s at \S+ m/s",
        ),
        (
            {"reference": {"residual": True}, "command": {"forward_m_s": [0.0, 4.0]}},
            r"cassie\.command\.forward_m_s: got \(0\.0, 4\.0\); expected within -0\.5 to 2\.5, where there are gaits",
        ),
        (
            {"reference": {"reward": {"joints": {"weight": 1.0}}}, "reward": {"height_m": 0.4}},
            r"cassie\.reward\.height_m: got 0\.4; expected within 0\.\d+ to ",
        ),
        (
            {"reference": {"residual": True}, "randomize": {"control_delay_s": [0, 0.01]}},
            r"cassie\.randomize\.control_delay_s: got .* expected \(0, 0\) with cassie\.reference\.residual",
        ),
    ],
)
def test_what_does_not_fit_is_refused_on_one_line(changes: dict, message: str) -> None:
    config = from_dict({"cassie": changes}, _config(start_share=0.5))
    with pytest.raises(ConfigError, match=message) as caught:
        check(config)
    assert "\n" not in str(caught.value)


def test_gaits_of_another_policy_rate_are_refused() -> None:
    config = from_dict({"physics": {"steps_per_env_step": 8}}, _config(start_share=0.5))
    with pytest.raises(ConfigError, match=r"gaits: got 'library'; expected gaits of .* 50 Hz; these are of 40 Hz"):
        check(config)


def _rewritten(path: Path, **changes: object) -> Path:
    """A copy of the library with parts of it, or of what it says of itself, replaced."""
    with np.load(gaits.PACKAGED[gaits.USUAL][0]) as file:
        arrays = dict(file)
    about = json.loads(str(arrays.pop("about")))
    arrays |= {name: value for name, value in changes.items() if name in arrays}
    about |= {name: value for name, value in changes.items() if name in about}
    np.savez(path, about=np.array(json.dumps(about)), **arrays)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints": ["hip", "knee"]}, "of a robot with the joints hip, knee…; expected pelvis"),
        ({"standing": np.zeros((1, 2))}, r"holds no gaits \(standing is \(1, 2\); expected"),
        ({"forward_m_s": np.array([0.0, 1, 3, 4, 5, 6, 7])}, "forward_m_s is not evenly spaced"),
        ({"curves": np.full(1, np.nan)}, "holds no gaits"),
    ],
)
def test_a_file_of_another_robot_or_a_damaged_one_is_refused(changes: dict, message: str, tmp_path: Path) -> None:
    path = _rewritten(tmp_path / "gaits.npz", **changes)
    with pytest.raises(ConfigError, match=message):
        make_task(_config(gaits=str(path), start_share=0.5))


def test_a_file_that_is_no_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "gaits.npz"
    path.write_bytes(b"no zip")
    with pytest.raises(ConfigError, match=r"cassie\.reference\.gaits: .*gaits\.npz holds no gaits"):
        gaits.load(str(path))


def test_degrees_of_the_polynomials() -> None:
    np.testing.assert_allclose(
        bezier.bernstein(np.array(0.25), np), [comb(5, k) * 0.25**k * 0.75 ** (5 - k) for k in range(6)]
    )
