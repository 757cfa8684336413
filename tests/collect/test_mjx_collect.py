"""Collection on MJX: the trajectories mean the same as those of the CPU pool, on one device and on eight.

The task is a cart-pole whose simulation fails at some angles, so that every way to end a step occurs.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.mjx import (
    ActingParameters,
    CollectorState,
    MjxCollector,
    MjxRollout,
    Statistics,
    environment_keys,
    make_mjx_plan,
)
from hasrl_jax.collect.protocol import Networks
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import StepResult
from hasrl_jax.envs.mjx_engine import make_engine
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task, Transition
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import distributions, normalize, ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.learn.ppo import make_mesh
from hasrl_jax.types import Trajectory

NUM_ENVS = 16
CONFIG = from_dict(
    {
        "task": "cartpole",
        "physics": {"timestep_s": 0.005},
        "network": {"hidden_size": 8, "symmetric": True, "initial_log_std": 0.5},
        "collect": {"env_steps_per_iteration": NUM_ENVS * 24, "unroll_length": 8, "max_episode_steps": 7},
        "ppo": {"minibatch_trajectories": 8},
    }
)
SEED, VERSION = 3, 5


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("num_envs", [1, 3, 64])
def test_no_environment_has_a_key_of_the_learner(seed: int, num_envs: int) -> None:
    environments = {tuple(key) for key in np.asarray(environment_keys(seed, num_envs)).tolist()}
    assert len(environments) == num_envs
    root = jax.random.key(seed)  # as in `train`; the learner goes on with the last of three
    learner = [root, *jax.random.split(root, 3)]
    learner += list(jax.random.split(learner[-1], 1 + CONFIG.ppo.epochs))
    assert not environments & {tuple(jax.random.key_data(key).tolist()) for key in learner}


def _fragile_task() -> Task:
    """The cart-pole, which terminates at 0.2 rad to either side, with a failing simulation beyond 0.12 rad to one."""
    task = make_task(CONFIG)

    def step(*arguments: Any) -> Transition:
        outcome = task.step(*arguments)
        fails = (outcome.measures > 0.12) & (outcome.measures < 0.2)
        return outcome._replace(reward_terms=jnp.where(fails, jnp.nan, outcome.reward_terms))

    return dataclasses.replace(task, step=step)


def _collector(num_devices: int) -> MjxRollout:
    task = _fragile_task()
    networks = make_networks(CONFIG.network, task.observation_size, task.action_size, task.mirror)
    engine = make_engine(task, "jax", CONFIG.collect.max_episode_steps)
    mesh = make_mesh(jax.devices()[:num_devices])
    return MjxRollout(make_mjx_plan(CONFIG, NUM_ENVS, num_devices), engine, *networks, mesh)


def _parameters(collector: MjxRollout) -> ActingParameters:
    """Random parameters, far enough from zero that a mistake anywhere shows."""
    observation = jnp.zeros((1, collector.engine.task.observation_size))
    shapes = [network.init(jax.random.key(0), observation)["params"] for network in (collector.policy, collector.value)]
    rng = np.random.default_rng(0)
    policy, value = jax.tree.map(lambda x: jnp.asarray(x + 0.3 * rng.standard_normal(x.shape), jnp.float32), shapes)
    return ActingParameters(policy, value, jnp.asarray([0.1, -0.2]), jnp.asarray([0.5, 2.0]))


class Run(SimpleNamespace):
    """Two iterations on eight devices: `states` before, between and after, `trajectories` and `statistics`."""

    collector: MjxRollout
    parameters: ActingParameters
    states: list[CollectorState]
    trajectories: list[Trajectory]
    statistics: list[Statistics]


@pytest.fixture(scope="module")
def run() -> Run:
    collector = _collector(8)
    parameters = _parameters(collector)
    state = collector.init(SEED)
    run = Run(
        collector=collector, parameters=parameters, states=[jax.device_get(state)], trajectories=[], statistics=[]
    )
    for _ in range(2):
        state, trajectory, statistics = collector(parameters, state, VERSION)
        run.states.append(jax.device_get(state))
        run.trajectories.append(jax.device_get(trajectory))
        run.statistics.append(jax.device_get(statistics))
    return run


@pytest.fixture
def by_env(run: Run) -> dict[str, np.ndarray]:
    """The first iteration by environment and time, [E, S, ...]."""
    trajectory = run.trajectories[0]._asdict()
    return {
        name: x.reshape(NUM_ENVS, -1, *x.shape[2:])
        for name, x in trajectory.items()
        if name not in ("initial_carry", "policy_version")
    }


def test_structure_is_that_of_the_cpu_pool(run: Run) -> None:
    trajectory, plan, task = run.trajectories[0], run.collector.plan, run.collector.engine.task
    assert (plan.rows, plan.max_length, plan.env_steps) == (48, 8, 384)
    specs = shared_memory.slot_specs(
        plan.env_steps, plan.rows, task.observation_size, task.action_size, plan.carry_shape
    )
    for name, field in trajectory._asdict().items():
        if name in specs:
            shape, dtype = specs[name]
            leading = (plan.rows,) if name == "initial_carry" else (plan.rows, plan.max_length)
            assert (field.shape, field.dtype) == ((*leading, *shape[1:]), np.dtype(dtype)), name
    np.testing.assert_array_equal(trajectory.policy_version, np.full(plan.rows, VERSION, np.int32))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((trajectory, run.states, run.statistics)))


def test_every_kind_of_ending_occurs(by_env: dict[str, np.ndarray]) -> None:
    for kind in ("terminated", "truncated"):
        assert by_env[kind][:, 1:7].any(), kind  # before the first cut of the buffer
    assert (~by_env["mask"])[:, 1:7].any()


def test_a_new_episode_follows_every_ending(run: Run, by_env: dict[str, np.ndarray]) -> None:
    assert run.states[0].envs.is_first.all()
    length = np.zeros(NUM_ENVS, int)
    for t in range(23):
        length = np.where(by_env["is_first"][:, t], 1, length + 1)
        ended = by_env["terminated"][:, t] | ~by_env["mask"][:, t] | (length == CONFIG.collect.max_episode_steps)
        np.testing.assert_array_equal(by_env["is_first"][:, t + 1], ended)


def test_cuts_bootstrap_from_what_follows(run: Run, by_env: dict[str, np.ndarray]) -> None:
    after = run.states[1].envs
    last_value = run.collector.value.apply({"params": run.parameters.value}, after.observation, *run.parameters[2:])
    value = np.concatenate([by_env["value"], np.asarray(last_value)[:, None]], axis=1)
    is_first = np.concatenate([by_env["is_first"], after.is_first[:, None]], axis=1)
    mask = np.concatenate([by_env["mask"], np.ones((NUM_ENVS, 1), bool)], axis=1)
    lost_in_the_middle = 0
    for env, t in np.ndindex(NUM_ENVS, 24):
        cut, bootstrap = by_env["truncated"][env, t], by_env["bootstrap_value"][env, t]
        if not mask[env, t] or by_env["terminated"][env, t]:
            assert not cut
            assert bootstrap == 0
        elif not is_first[env, t + 1]:  # the episode goes on
            next_is_lost = not mask[env, t + 1]
            assert cut == (t % 8 == 7 or next_is_lost)
            np.testing.assert_allclose(bootstrap, value[env, t + 1] if cut else 0.0, rtol=1e-5, atol=1e-6)
            lost_in_the_middle += bool(t % 8 != 7 and next_is_lost)
        else:
            assert cut  # the time limit
    assert lost_in_the_middle


def test_masked_steps_hold_nothing(by_env: dict[str, np.ndarray]) -> None:
    lost = ~by_env["mask"]
    assert not by_env["reward"][lost].any()
    assert not (by_env["terminated"] | by_env["truncated"])[lost].any()
    statistics = normalize.update(
        normalize.initial_normalizer(2), jnp.asarray(by_env["observation"]), jnp.asarray(by_env["mask"])
    )
    assert statistics.count == by_env["mask"].sum()


def test_the_learner_sees_the_same_probabilities(run: Run) -> None:
    """Replaying the rows from their initial carry gives the recorded log-probability: the ratio is 1."""
    trajectory, parameters = run.trajectories[0], run.parameters
    variables = {"params": parameters.policy}
    mean, _ = run.collector.policy.apply(
        variables, trajectory.observation, trajectory.initial_carry, trajectory.is_first, *parameters[2:]
    )
    log_std = run.collector.policy.apply(variables, method="log_std")
    log_prob = distributions.log_prob(trajectory.action, mean, log_std)
    np.testing.assert_allclose(log_prob, trajectory.log_prob, atol=1e-5)
    carry = trajectory.initial_carry.reshape(NUM_ENVS, 3, -1)
    is_first = trajectory.is_first.reshape(NUM_ENVS, 3, -1)[:, :, 0]
    np.testing.assert_array_equal(np.abs(carry).sum(axis=-1) == 0, is_first)


def test_statistics_are_sums_over_the_trajectories(run: Run, by_env: dict[str, np.ndarray]) -> None:
    statistics, mask = run.statistics[0], by_env["mask"]
    assert statistics.valid_steps == mask.sum()
    assert statistics.diverged == (~mask).sum() > 0
    np.testing.assert_allclose(statistics.reward_terms.sum(), by_env["reward"].sum(), rtol=1e-6)
    assert statistics.contact_overflow == statistics.constraint_overflow == 0
    episodes, total_return, total_length = 0, 0.0, 0
    for env in range(NUM_ENVS):
        episode_return, length = 0.0, 0
        for t in range(24):
            if by_env["is_first"][env, t]:
                episode_return, length = 0.0, 0
            episode_return, length = episode_return + by_env["reward"][env, t], length + 1
            if mask[env, t] and (by_env["terminated"][env, t] or length == CONFIG.collect.max_episode_steps):
                episodes, total_return, total_length = (
                    episodes + 1,
                    total_return + episode_return,
                    total_length + length,
                )
    assert (statistics.episodes, statistics.episode_length) == (episodes, total_length)
    np.testing.assert_allclose(statistics.episode_return, total_return, rtol=1e-6)


def test_the_scan_equals_stepping(run: Run, by_env: dict[str, np.ndarray]) -> None:
    """One environment step at a time, with the true final observation for the value at a time limit."""
    collector, (policy, value, *normalizer) = run.collector, run.parameters

    @jax.jit
    def one_step(state: CollectorState) -> tuple[CollectorState, jax.Array, StepResult, jax.Array]:
        envs, variables = state.envs, {"params": policy}
        mean, carry = collector.policy.apply(variables, envs.observation, state.carry, envs.is_first, *normalizer)
        log_std = collector.policy.apply(variables, method="log_std")
        keys = jax.vmap(jax.random.split)(state.key)
        action = mean + jnp.exp(log_std) * jax.vmap(lambda key: jax.random.normal(key, (1,)))(keys[:, 1])
        envs, result = jax.vmap(collector.engine.step)(envs, action)
        following = collector.value.apply({"params": value}, result.final_observation, *normalizer)
        return CollectorState(envs, carry, keys[:, 0]), action, result, following

    state, at_time_limit = run.states[0], 0
    for t in range(9):  # past the first cut
        np.testing.assert_allclose(by_env["observation"][:, t], state.envs.observation, atol=1e-5)
        state, action, result, following = jax.device_get(one_step(state))
        np.testing.assert_allclose(by_env["action"][:, t], action, atol=1e-5)
        np.testing.assert_array_equal(by_env["mask"][:, t], ~result.diverged)
        np.testing.assert_array_equal(by_env["reward"][:, t], result.reward)
        limit = result.truncated
        np.testing.assert_allclose(by_env["bootstrap_value"][limit, t], following[limit], atol=1e-5)
        at_time_limit += limit.sum()
    assert at_time_limit


def test_nothing_leaves_the_device_and_nothing_is_traced_twice(run: Run) -> None:
    collector = run.collector
    state = jax.device_put(jax.tree.map(np.copy, run.states[0]))
    parameters = jax.device_put(run.parameters)
    with jax.transfer_guard("disallow"):
        state, trajectory, _ = collector(parameters, state, VERSION)
        before = state.envs.qpos
        state, trajectory, _ = jax.block_until_ready(collector(parameters, state, VERSION))
    assert collector.trace_count == 1
    assert before.is_deleted()  # donated
    assert len(trajectory.reward.sharding.device_set) == len(state.envs.qpos.sharding.device_set) == 8


def test_one_device_and_eight_collect_the_same(run: Run) -> None:
    collector = _collector(1)
    state, trajectory, statistics = collector(run.parameters, collector.init(SEED), VERSION)
    for ours, theirs in ((state, run.states[1]), (trajectory, run.trajectories[0]), (statistics, run.statistics[0])):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), ours, theirs)


def test_collection_continues_from_saved_arrays(run: Run) -> None:
    """The state is plain arrays: what was saved between two iterations gives the same second one."""
    _, trajectory, _ = run.collector(run.parameters, jax.tree.map(np.copy, run.states[1]), VERSION)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(trajectory), run.trajectories[1])
    assert run.collector.trace_count == 1


def _with(**changes: Any) -> Config:
    return dataclasses.replace(CONFIG, collect=dataclasses.replace(CONFIG.collect, **changes))


def test_episodes_go_on_in_another_stage_unless_its_physics_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def make_rollout(_: MjxCollector, config: Config, task: Task) -> SimpleNamespace:
        made.append((config.physics, task))
        return SimpleNamespace(init=lambda seed: {"angle": np.zeros(3)})

    monkeypatch.setattr(MjxCollector, "_make_rollout", make_rollout)
    config, task = from_dict({"mjx": {"num_envs": 8}}, CONFIG), make_task(CONFIG)
    networks = Networks(*make_networks(CONFIG.network, task.observation_size, task.action_size, task.mirror))
    with MjxCollector(config, task, make_mesh(jax.devices()[:1]), networks) as collector:
        collector.state = {"angle": np.ones(3)}
        collector.configure(config, task)
        np.testing.assert_array_equal(collector.state["angle"], 1.0)
        finer = {
            "timestep_s": config.physics.timestep_s / 2,
            "steps_per_env_step": 2 * config.physics.steps_per_env_step,
        }
        other = from_dict({"physics": finer}, config)
        collector.configure(other, finer_task := make_task(other))
        np.testing.assert_array_equal(collector.state["angle"], 0.0)
        assert made[-1] == (other.physics, finer_task)
        collector.state = {"angle": np.ones(3)}
        collector.configure(other, finer_task)  # the stage after it has the same physics
        np.testing.assert_array_equal(collector.state["angle"], 1.0)


def test_the_plan_fills_whole_minibatches() -> None:
    plan = make_mjx_plan(_with(env_steps_per_iteration=1), num_envs=6, num_devices=2)
    assert (plan.steps_per_env, plan.rows, plan.carry_shape) == (32, 24, (2, 2, 16))
    assert make_mjx_plan(_with(env_steps_per_iteration=1000), num_envs=64, num_devices=8).steps_per_env == 16


def test_impossible_sizes_are_named() -> None:
    with pytest.raises(ConfigError, match=r"mjx.num_envs: 20 is not a multiple of the 8 devices; 16 is"):
        make_mjx_plan(CONFIG, num_envs=20, num_devices=8)
    with pytest.raises(ConfigError, match=r"mjx.num_envs: 4 is not a multiple of the 8 devices; 8 is"):
        make_mjx_plan(CONFIG, num_envs=4, num_devices=8)
    with pytest.raises(ConfigError, match=r"collect.mode: .* set it to unrolls"):
        make_mjx_plan(_with(mode="episodes"), num_envs=8, num_devices=8)


def test_too_little_memory_is_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    monkeypatch.setattr(run.collector, "_jitted", fail)
    with pytest.raises(MemoryError, match=r"mjx.num_envs: 16 environments .* try 8"):
        run.collector(run.parameters, run.states[0], VERSION)


def test_the_first_state_has_the_types_of_the_next() -> None:
    """A weak type, as a Python number has, would have the second iteration compiled anew."""
    changes = {
        "mjx": {"num_envs": 2},
        "collect": {"env_steps_per_iteration": 4, "unroll_length": 2},
        "ppo": {"minibatch_trajectories": 2},
    }
    config = from_dict(changes, shipped("cassie_walk"))
    task, mesh = make_task(config), ppo.make_mesh(jax.devices()[:1])
    sizes = (task.observation_size, task.action_size, task.mirror)
    learner = ppo.init_learner(config, *sizes, jax.random.key(0))
    statistics = normalize.mean_std(learner.normalizer)
    parameters = ActingParameters(learner.policy_params, learner.value_params, *statistics)
    networks = Networks(*make_networks(config.network, *sizes))
    with MjxCollector(config, task, mesh, networks) as collector:
        after = jax.eval_shape(collector.rollout._jitted, parameters, collector.state, jnp.int32(0))[0]
        before = jax.eval_shape(lambda state: state, collector.state)
    assert [(x.dtype, x.weak_type) for x in jax.tree.leaves(before)] == [
        (x.dtype, x.weak_type) for x in jax.tree.leaves(after)
    ]
