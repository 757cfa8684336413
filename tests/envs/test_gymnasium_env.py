"""The gymnasium interface."""

import copy
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import hasrl_jax  # noqa: F401 (importing it registers the environments)
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.gymnasium import TaskEnv, make
from hasrl_jax.envs.registration import ENVIRONMENTS
from hasrl_jax.errors import ConfigError

INFINITE_BOUNDS = "A Box observation space m.* value is"  # positions and velocities have no honest bounds


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_check_env(name: str) -> None:
    env = gymnasium.make(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=f".*{INFINITE_BOUNDS}")
        check_env(env.unwrapped, skip_render_check=True)  # rendering needs OpenGL and has a test of its own
    assert env.observation_space.dtype == np.float32
    assert env.metadata["render_fps"] == 40


@pytest.mark.parametrize(
    ("imports", "prefix"),
    [("hasrl_jax, gymnasium", ""), ("gymnasium, hasrl_jax.envs", ""), ("gymnasium", "hasrl_jax:")],
)
def test_registered_in_any_order_and_without_jax(imports: str, prefix: str) -> None:
    code = f"import sys, {imports}; gymnasium.make('{prefix}hasrl_jax/Cassie-v0'); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=60)


def test_equals_the_collectors_environments() -> None:
    env = make("cassie")
    observation, _ = env.reset(seed=3)
    envs = CpuEnvs(env.task, 1, env.config.collect.max_episode_steps)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(3)))
    state = envs.reset(rng)
    actions = np.random.default_rng(0).uniform(-1, 1, (200, 10)).astype(np.float32)
    for action in actions:
        np.testing.assert_array_equal(observation, state.observation[0].astype(np.float32))
        observation, reward, terminated, truncated, info = env.step(action)
        state, result = envs.step(state, action[None].astype(np.float64), rng)
        assert reward == result.reward[0]
        assert reward == pytest.approx(sum(value for name, value in info.items() if name.startswith("reward/")))
        assert {*env.task.measures, "diverged"} <= set(info)
        if terminated or truncated:
            break
    assert terminated
    np.testing.assert_array_equal(observation, result.final_observation[0].astype(np.float32))
    assert observation[0] < 0.95  # where the fall led, not the next episode
    with pytest.raises(RuntimeError, match="reset"):
        env.step(actions[0])


def test_a_command_of_the_reset_holds_for_its_episode() -> None:
    env = make("cassie")
    for told in ((0.8, -0.05), {"lateral": 0.1, "forward": -0.2}):
        command = tuple(told) if isinstance(told, tuple) else (told["forward"], told["lateral"])
        observation, _ = env.reset(seed=0, options={"command": told})
        np.testing.assert_allclose(observation[48:], command, rtol=1e-6)
        observation, *_, info = env.step(np.zeros(10, np.float32))
        np.testing.assert_allclose(observation[48:], command, rtol=1e-6)
        assert info["forward_command"] == pytest.approx(command[0])
    drawn = [tuple(env.reset(seed=seed)[0][48:]) for seed in range(4)]
    assert len(set(drawn)) > 1  # the option held for its own episode only


def test_neither_commands_nor_options_make_anything_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("cassie")
    task, envs = env.task, env._envs
    env.reset(seed=0, options={"command": (0.5,)})
    env.set_command(forward=1.0)
    env.reset(seed=1)
    assert env.task is task and env._envs is envs


def test_a_command_can_change_within_an_episode() -> None:
    env = make("cassie", from_dict({"cassie": {"command": {"resample_s": [0.05, 0.05]}}}))
    before, _ = env.reset(seed=0)
    observation = env.set_command(0.8, -0.05)
    np.testing.assert_array_equal(observation[:48], before[:48])
    np.testing.assert_allclose(observation[48:], [0.8, -0.05], rtol=1e-6)
    for _ in range(6):  # longer than a drawn command lasts
        observation, *_, info = env.step(np.zeros(10, np.float32))
        np.testing.assert_allclose(observation[48:], [0.8, -0.05], rtol=1e-6)
        assert (info["forward_command"], info["lateral_command"]) == (0.8, -0.05)
    env.set_command(-0.3, 0.0)
    assert env.step(np.zeros(10, np.float32))[4]["forward_command"] == -0.3
    fixed = make("cassie", env.config)
    fixed.reset(seed=0, options={"command": (0.8, -0.05)})
    again = make("cassie", env.config)
    again.reset(seed=0)
    again.set_command(0.8, -0.05)
    for _ in range(3):  # the same as a command that held from the start
        ours, theirs = again.step(np.zeros(10)), fixed.step(np.zeros(10))
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1] == theirs[1]


def test_commands_of_the_heading_frame() -> None:
    config = from_dict({"cassie": {"command": {"frame": "heading"}, "randomize": {"enabled": False}}})
    env = make("cassie", config)
    observation, _ = env.reset(seed=0, options={"command": (3.0, 0.0, 0.9, 0.7)})  # faster turns than any is drawn
    np.testing.assert_allclose(observation[48:], [3.0, 0.0, 0.9, 0.7], rtol=1e-6)
    info = env.step(np.zeros(10))[4]
    assert (info["yaw_rate_command"], info["height_command"]) == (0.9, 0.7)
    np.testing.assert_allclose(env.set_command(0.5, 0.1)[48:], [0.5, 0.1, 0.0, 0.9], rtol=1e-6)
    env.reset(seed=0)
    standing = env.set_command(0.0, 0.0)
    np.testing.assert_array_equal(standing[46:], [0, 0, 0, 0, 0, np.float32(0.9)])  # the clock rests at once
    with pytest.raises(ConfigError, match=r"expected at most 4 numbers: forward \(m/s\), .*height \(m\)$"):
        env.set_command(0.0, 0.0, 0.0, 0.9, 1.0)
    with pytest.raises(ConfigError, match=r"expected at most 2 numbers: forward \(m/s\), lateral \(m/s\)$"):
        make("cassie").reset(options={"command": (0.0, 0.0, 0.5)})
    with pytest.raises(ConfigError, match=r"command: got 'yaw_rate'; expected forward \(m/s\), lateral \(m/s\)$"):
        make("cassie").check_command((), yaw_rate=0.5)


def test_impossible_commands_are_refused() -> None:
    env = make("cassie")
    with pytest.raises(RuntimeError, match="reset"):
        env.set_command(0.0, 0.0)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="command forward: got nan; expected -10 to 10"):
        env.set_command(float("nan"), 0.0)
    with pytest.raises(ConfigError, match=r"command lateral: got 11\.0; expected -10 to 10"):
        env.set_command(0.0, 11.0)
    with pytest.raises(ConfigError, match="command forward: got 'fast'; expected a number, m/s"):
        env.set_command("fast")
    pole = make("cartpole")
    pole.reset(seed=0)
    with pytest.raises(ConfigError, match="cartpole"):
        pole.set_command(0.0, 0.0)


def test_a_randomized_robot_reports_its_step_and_pose() -> None:
    env = make("cassie", from_dict({"cassie": {"randomize": {"enabled": True}}}))
    env.reset(seed=0)
    assert env.step_s != env.task.env_step_s
    before = env._state.physics[0]
    env.step(np.zeros(10))
    assert env._state.physics[0] - before == pytest.approx(env.step_s)
    np.testing.assert_array_equal(env.qpos, env._state.physics[1 : 1 + env.task.model.nq])


def test_the_time_limit_truncates() -> None:
    env = make("cartpole", from_dict({"collect": {"max_episode_steps": 3}}))
    env.reset(seed=0)
    flags = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(3)]
    assert flags == [(False, False), (False, False), (False, True)]


def test_a_diverged_simulation_truncates_with_the_last_valid_observation() -> None:
    mujoco.set_mju_user_warning(lambda text: None)
    env = make("cassie")
    before, _ = env.reset(seed=0)
    env._state.physics[-1] = np.nan
    observation, reward, terminated, truncated, info = env.step(np.zeros(10, np.float32))
    assert (reward, terminated, truncated, info["diverged"]) == (0.0, False, True, True)
    np.testing.assert_array_equal(observation, before)


def momentum(env: TaskEnv) -> np.ndarray:
    """Of the whole robot, N s along the world's axes."""
    model, data = env.task.model, mujoco.MjData(env.task.model)
    data.qpos[:], data.qvel[:] = np.split(env._state.physics[1:], [model.nq])
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data.subtree_linvel[0] * model.body_mass.sum()


def test_a_push_is_a_force_on_the_pelvis_for_its_time_as_the_tasks_own() -> None:
    """Pushed on request, or by the task's own draw of the same force at the same moment: the same motion."""
    calm = {"randomize": {"enabled": False}}
    size, first = 100.0, 10  # N; environment step from which it acts
    push = {"force_n": [size, size], "interval_s": [0.24, 0.24]}
    drawn = make("cassie", from_dict({"cassie": calm | {"push": push}}))
    asked = make("cassie", from_dict({"cassie": calm}))
    plain = make("cassie", from_dict({"cassie": calm}))
    for env in (drawn, asked, plain):
        env.reset(seed=4)
    force = drawn._state.task.push
    assert np.linalg.norm(force) == pytest.approx(size)
    for step in range(22):
        if step == first:
            asked.push(*force)
        for env in (drawn, asked, plain):
            env.step(np.zeros(10))
        np.testing.assert_allclose(asked._state.physics, drawn._state.physics, rtol=0, atol=1e-12)
        if step == first:  # the first of the eight steps in which the force acts
            gained = momentum(asked) - momentum(plain)
            np.testing.assert_allclose(gained[:2], force * 0.025, atol=0.15 * size * 0.025)  # the feet take some of it
    with pytest.raises(ConfigError, match="'cartpole' cannot be pushed"):
        make("cartpole").push(1.0, 0.0)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_as_the_original(duplicate: Callable[[TaskEnv], TaskEnv]) -> None:
    env = make("cassie", from_dict({"cassie": {"randomize": {"enabled": True}}}))
    env.reset(seed=0)
    env.step(np.zeros(10))
    twin = duplicate(env)
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 10)):
        ours, theirs = env.step(action), twin.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:4] == theirs[1:4]
        if ours[2]:
            break


def test_bad_arguments() -> None:
    with pytest.raises(ConfigError, match="task"):
        make("hopper")
    with pytest.raises(ConfigError, match="track"):
        TaskEnv(camera="nowhere")
    with pytest.raises(ConfigError, match="render_mode"):
        TaskEnv(render_mode="human")
    env = make("cassie")
    with pytest.raises(RuntimeError, match="reset"):
        env.step(np.zeros(10))
    with pytest.raises(ValueError, match="speed"):
        env.reset(options={"speed": 1})
    with pytest.raises(ConfigError, match="command lateral: got nan"):
        env.reset(options={"command": (1.0, float("nan"))})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="shape"):
        env.step(np.zeros(9))
    with pytest.raises(FloatingPointError):
        env.step(np.full(10, np.nan))
