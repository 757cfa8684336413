"""One worker's collection, in this process."""

import jax
import numpy as np
import pytest

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.buffer import pad_segments
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.worker import Actor
from hasrl_jax.learn import distributions
from hasrl_jax.learn.networks import Policy, make_networks

MODES = ("unrolls", "episodes")


class Collector:
    """An actor with a slot of its own."""

    def __init__(self, config, parameters, index=0):
        self.config, self.plan, self.parameters = config, make_plan(config), parameters
        self.actor = Actor(config, self.plan, index)
        task = self.actor.task
        self.block = shared_memory.open_block(config, self.plan, task.observation_size, task.action_size)

    def collect(self, iteration=0):
        """A copy of the slot after one collection, without its unused entries, and the statistics."""
        slot = self.block.slots[0][0]
        for array in slot.values():
            array[...] = 1  # what an earlier iteration left must not show
        statistics = self.actor.collect(self.parameters, slot, iteration, lambda: None)
        count = int(slot["num_segments"][0])
        per_segment = ("start", "end", "initial_carry")
        return {name: (a[:count] if name in per_segment else a).copy() for name, a in slot.items()}, statistics


@pytest.fixture
def collector(make_config, make_parameters):
    def make(task="cartpole", symmetric=False, index=0, **collect):
        config = make_config(task, symmetric, **collect)
        return Collector(config, make_parameters(config), index)

    return make


def assert_equal(first, second):
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.parametrize("mode", MODES)
def test_segments_tile_the_buffer_and_end_where_they_should(collector, mode):
    slot, _ = collector(mode=mode, max_episode_steps=5).collect()
    start, end = slot["start"], slot["end"]
    assert start[0] == 0
    assert end[-1] == 96
    np.testing.assert_array_equal(start[1:], end[:-1])
    ended = slot["terminated"] | slot["truncated"]
    assert ended[end - 1].all()
    if mode == "unrolls":
        np.testing.assert_array_equal(end - start, 8)
    else:
        assert slot["is_first"][start].all()
        assert slot["is_first"].sum() == len(start)
        assert ended.sum() == len(start)


@pytest.mark.parametrize("mode", MODES)
def test_an_episode_begins_after_every_end_and_nowhere_else(collector, mode):
    slot, _ = collector(mode=mode, max_episode_steps=5).collect()
    is_first = slot["is_first"].reshape(4, -1)
    over = (slot["episode_length"] > 0).reshape(4, -1)
    np.testing.assert_array_equal(is_first[:, 1:], over[:, :-1])
    assert is_first[:, 0].all()
    assert slot["episode_length"].max() == 5
    capped = slot["truncated"] & (slot["episode_length"] == 5)
    assert capped.any()
    np.testing.assert_array_equal(slot["episode_return"][capped], 5.0)


@pytest.mark.parametrize("mode", MODES)
def test_cut_steps_bootstrap_from_the_state_that_follows(collector, mode):
    subject = collector(mode=mode)
    slot, _ = subject.collect()
    value, first = slot["value"].reshape(4, -1), slot["is_first"].reshape(4, -1)
    cut = slot["truncated"].reshape(4, -1)
    bootstrap = slot["bootstrap_value"].reshape(4, -1)
    assert not (slot["terminated"] & slot["truncated"]).any()
    np.testing.assert_array_equal(bootstrap[~cut], 0.0)
    assert np.all(bootstrap[cut] != 0.0)
    # Where only the buffer cut, the next recorded state of the same environment is the one that follows.
    inside = cut[:, :-1] & ~first[:, 1:]
    assert inside.any() == (mode == "unrolls")
    np.testing.assert_allclose(bootstrap[:, :-1][inside], value[:, 1:][inside], atol=1e-6)
    if mode == "unrolls":  # and at the end of the buffer the first state of the next iteration
        following, _ = subject.collect(1)
        goes_on = cut[:, -1] & ~following["is_first"].reshape(4, -1)[:, 0]
        expected = following["value"].reshape(4, -1)[goes_on, 0]
        np.testing.assert_allclose(bootstrap[goes_on, -1], expected, atol=1e-6)


@pytest.mark.parametrize(("task", "symmetric"), [("cartpole", False), ("cassie", True)])
@pytest.mark.parametrize("mode", MODES)
def test_ratio_is_one_for_everything_collected(collector, mode, task, symmetric):
    subject = collector(task, symmetric, mode=mode)
    subject.collect(0)
    slot, _ = subject.collect(1)  # in unrolls, the carries now come from an earlier iteration
    count = len(slot["start"])
    fields = slot | {"policy_version": np.zeros(count, np.int32)}
    batch = pad_segments(fields, slot["start"], slot["end"], subject.plan.max_length, count)
    definition = subject.actor.task
    sizes = definition.observation_size, definition.action_size, definition.mirror
    policy, _ = make_networks(subject.config.network, *sizes)
    own = {name.split("/")[1]: array for name, array in subject.parameters.items() if name.startswith("policy/")}
    normalizer = subject.parameters["normalizer/mean"], subject.parameters["normalizer/std"]
    steps = batch.observation, batch.initial_carry, batch.is_first
    mean, _ = jax.jit(policy.apply)({"params": own}, *steps, *normalizer)
    log_std = policy.apply({"params": own}, method=Policy.log_std)
    ratio = np.exp(distributions.log_prob(batch.action, mean, log_std) - batch.log_prob)
    assert batch.mask.sum() == 96
    np.testing.assert_allclose(ratio[batch.mask], 1.0, atol=2e-4)


def test_same_seed_same_numbers_and_other_workers_other_numbers(collector):
    first, same, other = (collector(index=index).collect(3)[0] for index in (0, 0, 1))
    assert_equal(first, same)
    assert np.all(first["action"] != other["action"])


@pytest.mark.parametrize("task", ["cartpole", "cassie"])
def test_save_and_load_continue_identically(collector, task):
    original, restored = collector(task), collector(task)
    original.collect(0)
    assert restored.actor.load(original.actor.save())
    assert_equal(original.collect(1)[0], restored.collect(1)[0])


def test_load_refuses_nothing_and_other_sizes(collector):
    subject, larger = collector(), collector(envs_per_worker=5)
    larger.collect()
    assert not subject.actor.load(subject.actor.save())
    assert not subject.actor.load(larger.actor.save())
    assert_equal(subject.collect()[0], collector().collect()[0])


def test_a_diverged_environment_is_masked_and_starts_anew(collector, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file in the working directory
    subject = collector("cassie", max_episode_steps=100)
    subject.collect(0)
    state = subject.actor.state
    state.physics[2, 1:] = 1e30  # a state that no simulation survives
    slot, statistics = subject.collect(1)
    mask = slot["mask"].reshape(4, -1)
    assert statistics["diverged"] == 1
    assert not mask[2, 0]
    assert mask.sum() == 95
    assert slot["is_first"].reshape(4, -1)[2, 1]
    assert np.isfinite(slot["observation"]).all()
    assert np.isfinite(slot["reward"]).all()


def test_parameters_that_are_not_numbers_raise(collector):
    subject = collector()
    subject.parameters["policy/mean_bias"][:] = np.nan
    with pytest.raises(FloatingPointError, match="not finite"):
        subject.collect()


def test_statistics_say_where_the_time_goes(collector):
    _, statistics = collector("cassie").collect()
    spent = [statistics[f"{item}_cpu_seconds"] for item in ("physics", "inference", "environment")]
    assert min(spent) > 0
    assert len(statistics["reward_terms"]) == 9
