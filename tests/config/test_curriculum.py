"""The curriculum: what each stage sets, when it begins, and what is refused."""

import re
from pathlib import Path

import pytest

from hasrl_jax.cli.train import parse_train
from hasrl_jax.config import curriculum
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.curriculum import WINDOW, Stages
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn.ppo import make_update
from hasrl_jax.train.loop import make_parts

STAGES = [
    {"at_env_steps": 1000, "set": {"cassie.command.start_moving": 0.6}},
    {"at_env_steps": 2000, "set": {"cassie.command.forward_m_s": [-0.3, 1.0], "ppo.clip": 0.1}},
]
WAITING = [{"at_env_steps": 1000, "wait_for": {"episode_length_train": 50.0}, "set": {"ppo.clip": 0.1}}, STAGES[1]]


def test_settings_change_and_stay() -> None:
    config = from_dict({"stages": STAGES, "total_env_steps": 5000})
    first, second, third = curriculum.resolve(config)
    assert first == config
    assert second.settings.command.start_moving == third.settings.command.start_moving == 0.6
    assert second.ppo.clip == 0.2
    assert third.settings.command.forward_m_s == (-0.3, 1.0)
    assert third.ppo.clip == 0.1


def test_a_stage_may_set_a_group_of_settings() -> None:
    config = from_dict({"stages": [{"at_env_steps": 1, "set": {"cassie.push": {"force_n": [0, 50]}}}]})
    assert curriculum.resolve(config)[1].settings.push.force_n == (0.0, 50.0)


def test_without_stages_there_is_one_part() -> None:
    assert curriculum.resolve(from_dict({})) == [from_dict({})]


def advance(stages: Stages, env_steps: int, record: dict) -> bool:
    """Whether another stage has begun, as a run does it."""
    reached = stages.reached(env_steps, record)
    if reached:
        stages.begin()
    return reached


def test_stages_begin_one_after_the_other_at_their_steps() -> None:
    stages = Stages(from_dict({"stages": STAGES}).stages, 0, {})
    assert [advance(stages, steps, {}) for steps in (999, 1000, 1999, 2000, 9999)] == [False, True, False, True, False]
    assert stages.current == 2
    behind = Stages(from_dict({"stages": STAGES}).stages, 0, {})
    assert [advance(behind, 5000, {}) for _ in range(3)] == [True, True, False]  # both are over, one an iteration


def test_a_stage_waits_for_the_mean_of_a_metric_and_holds_up_those_behind_it() -> None:
    stages = Stages(from_dict({"stages": WAITING}).stages, 0, {})
    for value in [None] + [49.0] * WINDOW:
        assert not advance(stages, 3000, {"episode_length_train": value})
        assert not stages.due(3000)
    assert [advance(stages, 3000, {"episode_length_train": 51.0}) for _ in range(5)] == [False] * 4 + [True]
    assert stages.due(3000)  # the one behind it waits for nothing
    assert stages.current == 1


def test_what_a_stage_waits_for_outlives_a_break() -> None:
    configured = from_dict({"stages": WAITING}).stages
    before = Stages(configured, 0, {})
    for _ in range(WINDOW - 1):
        advance(before, 3000, {"episode_length_train": 60.0})
    after = Stages(configured, before.current, before.history)
    assert advance(after, 3000, {"episode_length_train": 60.0})


def test_an_unknown_metric_is_refused_at_the_first_iteration() -> None:
    stages = Stages(from_dict({"stages": [WAITING[0] | {"wait_for": {"episode_lenght": 1.0}}]}).stages, 0, {})
    with pytest.raises(ConfigError, match=r"wait_for names 'episode_lenght', which is no metric; known are iteration"):
        advance(stages, 10, {"iteration": 1})


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (["4e6 ppo.clip=0.1"], r"config.stages\[0\]: expected a mapping of fields, got '4e6"),
        ([{"at_env_steps": "soon", "set": {"ppo.clip": 0.1}}], r"stages\[0\].at_env_steps: got 'soon'; expected int"),
        ([{"at_env_steps": 0, "set": {"ppo.clip": 0.1}}], r"stages\[0\].at_env_steps: got 0; expected"),
        ([{"at_env_steps": 100}], r"stages\[0\].set: got nothing; expected"),
        ([{"at_env_steps": 100, "set": {"ppo": {}}}], r"stages\[0\].set: got nothing; expected"),
        (
            [{"at_env_steps": 100, "set": {"physics.timestep_s": 0.005}}],
            r"stages\[0\].set: physics.timestep_s times steps_per_env_step is 0.05 s; expected 0.025 s, as before",
        ),
        ([{"at_env_steps": 100, "set": {"network.hidden_size": 4}}], r"network.hidden_size cannot change during a run"),
        ([{"at_env_steps": 100, "set": {"network": {"learn_std": False}}}], r"learn_std cannot change during a"),
        (
            [{"at_env_steps": 100, "set": {"network.initial_log_std": -1.0}}],
            r"stages\[0\].set: network.initial_log_std: a stage can set it where network.learn_std is false",
        ),
        ([{"at_env_steps": 100, "set": {"cassie.push.force": [0, 1]}}], r"config.cassie.push.force: unknown field"),
        ([{"at_env_steps": 100, "set": {"cassie.push.force_n": [5, 1]}}], r"cassie.push.force_n: got .* low <= high"),
        ([{"at_env_steps": 9, "set": {"ppo.clip": 0.1, "ppo": {"clip": 0.2}}}], r"set: ppo.clip is given twice"),
        ([STAGES[0], STAGES[0]], r"stages\[1\].at_env_steps: got 1000; expected more than 1000"),
        ([{"at_env_steps": 1, "set": {"ppo.clip": 0.1}, "wait_for": {"x": "much"}}], r"wait_for.x: got 'much'"),
    ],
)
def test_what_is_refused(stages: list, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        curriculum.resolve(from_dict({"stages": stages}))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cassie.action_range_rad": 1.4}, "what the actions stand for (motor_targets"),
        ({"cassie.command.frame": "heading"}, "what the policy sees ("),
    ],
)
def test_a_stage_may_not_change_what_the_parameters_mean(settings: dict, message: str) -> None:
    stages = [STAGES[0], {"at_env_steps": 1500, "set": settings}]
    with pytest.raises(ConfigError, match=rf"^stages\[1\].set: this changes {re.escape(message)}.*; begin another run"):
        make_parts(from_dict({"stages": stages}), make_update)


def test_the_command_line_takes_stages_as_data_and_refuses_before_anything_starts(tmp_path: Path) -> None:
    config = parse_train(["--config", "smoke", "--stages", "[{at_env_steps: 5, set: {ppo.clip: 0.1}}]"])[0]
    assert curriculum.resolve(config)[1].ppo.clip == 0.1
    assert parse_train(["--stages", "[]"])[0].stages == ()
    file = tmp_path / "config.yaml"
    file.write_text("stages: [{at_env_steps: 100, set: {ppo.klip: 0.1}}]\n")
    for arguments in (["--config", str(file)], ["--stages", "[{at_env_steps: 100, set: {ppo.klip: 0.1}}]"]):
        with pytest.raises(ConfigError, match=r"stages\[0\].set: config.ppo.klip: unknown field"):
            parse_train(arguments)
