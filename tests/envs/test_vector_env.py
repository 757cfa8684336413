"""The vector environment: gymnasium's definition of it, on the engine of the collectors."""

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import hasrl_jax  # noqa: F401 (importing it registers the environments)
from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs import gymnasium as single
from hasrl_jax.envs import vector
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.errors import ConfigError

MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]
SHORT = {"collect": {"max_episode_steps": 7}}
CASSIE, POLE = "hasrl_jax/Cassie-v0", "hasrl_jax/CartpoleHiddenVelocity-v0"


def described(info: dict[str, Any]) -> dict[str, Any]:
    """Shapes and types of what an info holds, and the values of its masks."""
    found: dict[str, Any] = {}
    for name, value in info.items():
        if isinstance(value, dict):
            found[name] = described(value)
        else:
            found[name] = (value.dtype, value.shape, value.tolist() if name.startswith("_") else None)
    return found


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", [CASSIE, POLE])
def test_says_what_gymnasiums_own_vector_of_the_single_environment_says(name: str, mode: AutoresetMode) -> None:
    """Up to and over an episode's end; the random numbers of the next episode are others."""
    task = "cassie" if name == CASSIE else "cartpole"
    ours = gymnasium.make_vec(name, num_envs=1, config=from_dict({"task": task} | SHORT), autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: single.make(task, from_dict(SHORT))], autoreset_mode=mode)
    assert isinstance(ours, vector.TaskVectorEnv) and ours.metadata == theirs.metadata
    for space in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    np.testing.assert_array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    actions = np.random.default_rng(0).uniform(-1, 1, (9, *ours.action_space.shape)).astype(np.float32)
    for step, action in enumerate(actions, 1):
        a, b = ours.step(action), theirs.step(action)
        if step < 8 or mode is AutoresetMode.NEXT_STEP:
            for mine, other in zip(a[1:4], b[1:4], strict=True):
                assert mine.dtype == other.dtype and mine.shape == other.shape
                if step <= 8:
                    np.testing.assert_array_equal(mine, other)
        if step < 7 or (step == 7 and mode is AutoresetMode.NEXT_STEP):
            np.testing.assert_array_equal(a[0], b[0])
        mine, other = described(a[4]), described(b[4])
        if mode is AutoresetMode.SAME_STEP and step == 7:
            np.testing.assert_array_equal(a[4]["final_obs"][0], b[4]["final_obs"][0])
            for key, value in b[4]["final_info"].items():
                np.testing.assert_array_equal(a[4]["final_info"][key], value)
            mine = {key: mine[key] for key in other}  # ours also has the measures, masked out
            assert not any(a[4][key].any() for key in a[4] if key.startswith("_reward"))
        elif mode is AutoresetMode.NEXT_STEP and step == 8:
            assert not any(value.any() for key, value in a[4].items() if key.startswith("_"))
            continue  # gymnasium leaves out what no environment has
        assert mine == other
    assert (step, a[3].tolist()) == (9, [False])


def rows_of(state: Any, env: int) -> Any:
    """The state of one environment as that of an engine with one."""
    some = slice(env, env + 1)
    return state._replace(
        task=type(state.task)(*(array[some] for array in state.task)),
        model_fields={name: array[some] for name, array in state.model_fields.items()},
        **{name: getattr(state, name)[some] for name in state._fields if name not in ("task", "model_fields")},
    )


@pytest.mark.parametrize("limit", [12, 1])  # with 1 episodes also end while they are held
@pytest.mark.parametrize("mode", MODES)
def test_every_environment_goes_on_as_if_it_were_alone(mode: AutoresetMode, limit: int) -> None:
    """Randomised robots that fall at different times; each step is done again by an engine with one environment."""
    task = {"cassie": {"randomize": {"enabled": True}, "command": {"resample_s": [100, 100]}}}
    envs = vector.make(
        "cassie", from_dict(task | {"collect": {"max_episode_steps": limit}}), num_envs=5, autoreset_mode=mode
    )
    alone = CpuEnvs(envs.task, 1, limit)
    envs.reset(seed=1)
    rng = np.random.default_rng(0)
    over = np.zeros(5, bool)
    for env in range(5):
        envs._state.episode_step[env] = env if limit > 5 else 0  # so that they end one after the other
    resets = 0
    for _ in range(40):
        before = envs._state
        actions = rng.uniform(-1, 1, (5, 10))
        following, reward, terminated, truncated, info = envs.step(actions)
        for env in range(5):
            if over[env]:
                resets += 1
                assert (reward[env], terminated[env], truncated[env]) == (0.0, False, False)
                np.testing.assert_array_equal(following[env], before.observation[env].astype(np.float32))
                assert envs._state.is_first[env] and envs._state.episode_step[env] == 0
                assert not info["_forward_speed"][env]
                continue
            one = rows_of(before, env)
            alone.restore(one)
            _, result = alone.step(one, actions[env : env + 1], rng)
            assert reward[env] == result.reward[0]
            ended = terminated[env] or truncated[env]
            assert ended == (result.terminated[0] or result.truncated[0])
            led_to = result.final_observation[0].astype(np.float32)
            if ended and mode is AutoresetMode.SAME_STEP:
                np.testing.assert_array_equal(info["final_obs"][env], led_to)
                np.testing.assert_array_equal(following[env], envs._state.observation[env].astype(np.float32))
                assert info["final_info"]["forward_speed"][env] == result.measures[0, 0]
                resets += 1
            else:
                np.testing.assert_array_equal(following[env], led_to)
                assert info["forward_speed"][env] == result.measures[0, 0]
        if mode is AutoresetMode.NEXT_STEP:
            over = terminated | truncated
    assert resets > 10


def test_the_statistics_wrapper_of_gymnasium_counts_the_returns() -> None:
    envs = vector.make("cartpole", from_dict(SHORT), num_envs=3, autoreset_mode="NextStep")
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    wrapped.reset(seed=0)
    for _ in range(7):
        *_, info = wrapped.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(info["episode"]["r"], [7, 7, 7])
    np.testing.assert_array_equal(info["episode"]["l"], [7, 7, 7])


def test_the_same_seed_gives_the_same_episodes_and_another_others() -> None:
    a, b = (vector.make("cassie", num_envs=3) for _ in range(2))
    np.testing.assert_array_equal(a.reset(seed=5)[0], b.reset(seed=5)[0])
    actions = np.zeros((3, 10))
    np.testing.assert_array_equal(a.step(actions)[0], b.step(actions)[0])
    assert not np.array_equal(a.reset(seed=5)[0], b.reset(seed=6)[0])
    assert not np.array_equal(a.reset(seed=5)[0], a.reset()[0])


@pytest.mark.parametrize("mode", MODES)
def test_a_diverged_simulation_truncates_with_the_last_valid_observation(mode: AutoresetMode) -> None:
    mujoco.set_mju_user_warning(lambda text: None)
    envs = vector.make("cassie", num_envs=2, autoreset_mode=mode)
    before, _ = envs.reset(seed=0)
    envs._state.physics[1, -1] = np.nan
    observation, reward, terminated, truncated, info = envs.step(np.zeros((2, 10)))
    same_step = mode is AutoresetMode.SAME_STEP
    led_to = info["final_obs"][1] if same_step else observation[1]
    np.testing.assert_array_equal(led_to, before[1])
    assert (reward[1], terminated.tolist(), truncated.tolist()) == (0.0, [False, False], [False, True])
    assert (info["final_info"] if same_step else info)["diverged"].tolist() == [False, True]
    assert reward[0] != 0 and np.isfinite(observation).all()


def test_commands_reach_every_robot_until_its_episode_ends() -> None:
    envs = vector.make("cassie", from_dict(SHORT), num_envs=3, autoreset_mode="SameStep")
    observation, _ = envs.reset(seed=0, options={"command": {"forward": 0.7}})
    np.testing.assert_allclose(observation[:, 48:], [[0.7, 0.0]] * 3, rtol=1e-6)
    envs._state.episode_step[1] = 5
    observation = envs.set_command(0.3, 0.1)
    np.testing.assert_allclose(observation[:, 48:], [[0.3, 0.1]] * 3, rtol=1e-6)
    envs.step(np.zeros((3, 10)))
    *_, info = envs.step(np.zeros((3, 10)))
    np.testing.assert_allclose(envs._last[[0, 2], 48], 0.3, rtol=1e-6)
    assert info["final_info"]["forward_command"][1] == 0.3 and abs(envs._last[1, 48] - 0.3) > 1e-3


def test_impossible_arguments_are_refused_on_one_line() -> None:
    with pytest.raises(ConfigError, match=r"^num_envs: got 0; expected a whole number from 1$"):
        gymnasium.make_vec(CASSIE, num_envs=0)
    with pytest.raises(ConfigError, match=r"^autoreset_mode: got 'Disabled'; expected 'NextStep' or 'SameStep'$"):
        vector.make("cassie", autoreset_mode="Disabled")
    with pytest.raises(ConfigError, match=r"^camera: got 'nowhere'; expected one of track, "):
        vector.make("cassie", camera="nowhere")
    with pytest.raises(ConfigError, match=r"^render_mode: got 'human'"):
        vector.make("cassie", render_mode="human")
    envs = vector.make("cartpole", num_envs=2)
    with pytest.raises(RuntimeError, match="reset"):
        envs.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="'speed'"):
        envs.reset(options={"speed": 1})
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"^actions: got shape \(1, 1\); expected \(2, 1\)$"):
        envs.step(np.zeros((1, 1)))
    with pytest.raises(ConfigError, match="cartpole"):
        envs.set_command(1.0)
