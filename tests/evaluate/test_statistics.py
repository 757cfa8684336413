"""What episodes amount to, against numbers worked out by hand."""

import numpy as np
import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.envs.registry import make_task
from hasrl_jax.evaluate import statistics
from hasrl_jax.evaluate.rollout import Episodes

TASK = make_task(from_dict({}))
COMMANDS = TASK.commands


def test_intervals_by_hand():
    # 2.5 +- 1.96 * sqrt(5/3) / sqrt(4); what is not a number does not count.
    found = statistics.mean_interval(np.array([1.0, np.nan, 2.0, 3.0, 4.0, np.inf]))
    np.testing.assert_allclose([found["mean"], found["low"], found["high"]], [2.5, 1.234826, 3.765174], atol=1e-6)
    assert statistics.mean_interval(np.array([3.0])) == {"mean": 3.0, "low": 3.0, "high": 3.0}
    assert statistics.mean_interval(np.array([np.nan])) == {"mean": None, "low": None, "high": None}


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [
        (8, 10, 0.490157, 0.943319),  # (0.8 + 0.19208 -+ 1.96 sqrt(0.016 + 0.009604)) / 1.38416
        (0, 10, 0.0, 0.277540),
        (10, 10, 0.722460, 1.0),
        (50, 100, 0.403830, 0.596170),
    ],
)
def test_wilson_intervals_by_hand(hits, of, low, high):
    found = statistics.share_interval(np.arange(of) < hits)
    np.testing.assert_allclose([found["mean"], found["low"], found["high"]], [hits / of, low, high], atol=1e-6)
    assert statistics.share_interval(np.zeros(0, bool)) == {"mean": None, "low": None, "high": None}


def test_a_speed_error_does_not_cancel_between_commands():
    nan = np.nan
    command = [[1, 1, 1, 1, 2, 2], [1, 1, 1, nan, nan, nan], [1, nan, nan, nan, nan, nan]]  # the last two fall
    speed = [[0, 1, 1.2, 1.1, 0, 1.6], [0, 1, 1.3, nan, nan, nan], [0, nan, nan, nan, nan, nan]]
    still = np.where(np.isfinite(np.transpose(command)), 0.0, nan)
    column = {"forward_command": np.transpose(command), "forward_speed": np.transpose(speed)}
    column |= {"lateral_command": still, "lateral_speed": still}
    speeds = statistics.settled_errors(column, COMMANDS, env_step_s=statistics.SETTLE_S)
    np.testing.assert_allclose(speeds["forward_speed_error"], [(3 * 0.1 + 0.4) / 4, 0.15, nan])
    np.testing.assert_allclose(speeds["forward_speed"], [1.225, 1.15, nan])
    np.testing.assert_allclose(speeds["lateral_speed_error"], [0.0, 0.0, nan])
    swapped = {"forward_command": still, "forward_speed": still}
    swapped |= {"lateral_command": column["forward_command"], "lateral_speed": column["forward_speed"]}
    speeds = statistics.settled_errors(swapped, COMMANDS, env_step_s=statistics.SETTLE_S)
    np.testing.assert_allclose(speeds["lateral_speed_error"], [(3 * 0.1 + 0.4) / 4, 0.15, nan])


def test_an_error_counts_from_the_settling_time_after_each_command() -> None:
    """Two commands of four steps and one of three, settled after two steps each; the second command is the first's."""
    command = np.array([1.0, 1, 1, 1, 3, 3, 3, 3, 1, 1, 1])[:, None]
    expected = [False, False, True, True] * 2 + [False, False, True]
    np.testing.assert_array_equal(statistics.settled_steps(command, 2)[:, 0], expected)
    np.testing.assert_array_equal(statistics.settled_steps(command, 0)[:, 0], True)
    assert not statistics.settled_steps(np.full((4, 1), np.nan), 0).any()


def test_errors_of_a_command_weigh_as_long_as_it_was_held() -> None:
    settled = np.array([[0, 1, 1, 0, 1, 1, 1, 1], [1, 0, 0, 0, 0, 0, 0, 1], [0] * 8]).T.astype(bool)
    error = np.array([[9, 1, -3, 9, 2, 2, 2, -1], [-0.5, 9, 9, 9, 9, 9, 9, 0.1], [9] * 8]).T
    # |1 - 3| + |2 + 2 + 2 - 1| over 6 steps; |-0.5| + |0.1| over 2.
    np.testing.assert_allclose(statistics.command_error(error, settled), [7 / 6, 0.3, np.nan])
    np.testing.assert_allclose(statistics.settled_mean(error, settled), [3 / 6, -0.2, np.nan])
    once = np.array([[False, True, False]]).T
    for compute in (statistics.command_error, statistics.settled_mean):
        np.testing.assert_allclose(compute(np.array([[5.0, 7.0, 9.0]]).T, once), [7.0])  # a single step is enough
    assert statistics.command_error(np.zeros((0, 2)), np.zeros((0, 2), bool)).shape == (2,)


def test_a_summary_by_hand() -> None:
    """Two episodes of the walking task: one to the cap, settled for its last two steps, and one that diverged."""
    steps = 120 + 2  # a command settles within 3 s of 25 ms each
    measures = np.zeros((steps, 2, len(TASK.measures)))
    place = TASK.measures.index
    measures[:, :, place("forward_command")] = 1.0
    measures[:, 0, place("forward_speed")] = 5.0
    measures[-2:, 0, place("forward_speed")] = 0.7, 1.1
    measures[-2:, 0, place("lateral_speed")] = 0.2
    measures[:, 0, place("motor_power")] = 200.0
    measures[:, 1, place("motor_power")] = 100.0, 40.0, 10.0, *[np.nan] * (steps - 3)
    measures[3:, 1] = np.nan
    episodes = Episodes(
        episode_return=np.array([10.0, 4.0]),
        episode_length=np.array([steps, 3]),
        reached_cap=np.array([True, False]),
        seconds=np.array([steps, 3]) * TASK.env_step_s,
        diverged=np.array([False, True]),
        reached_goal=np.array([False, False]),
        action_change=np.array([0.3, 0.1]),
        measures=measures,
    )
    found = statistics.summarize(episodes, TASK)
    assert (found["episodes"], found["diverged_episodes"], found["settled_episodes"]) == (2, 1, 1)
    np.testing.assert_allclose(list(found["episode_return"].values()), [7.0, 7 - 1.96 * 3, 7 + 1.96 * 3])
    assert found["episode_length"]["mean"] == (steps + 3) / 2
    assert found["seconds_upright"]["mean"] == pytest.approx((steps + 3) / 2 * 0.025)
    assert found["share_reaching_cap"]["mean"] == 0.5
    assert found["action_change"]["mean"] == pytest.approx(0.2)
    assert found["motor_power"]["mean"] == pytest.approx((200 + 50) / 2)
    expected = {
        **{"forward_speed": 0.9, "forward_command": 1.0, "forward_speed_error": 0.1},
        **{"forward_speed_error_instantaneous": 0.2, "lateral_speed": 0.2, "lateral_command": 0.0},
        **{"lateral_speed_error": 0.2, "lateral_speed_error_instantaneous": 0.2},
    }
    for name, mean in expected.items():
        assert found[name] == {end: pytest.approx(mean) for end in ("mean", "low", "high")}, name
    assert "forward_speed" not in statistics.summarize(episodes, make_task(from_dict({"task": "cartpole"})))
