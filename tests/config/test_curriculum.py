"""The curriculum: what each stage sets, in what order, and what is refused."""

from pathlib import Path

import pytest

from hasrl_jax.cli.parsing import parse_train
from hasrl_jax.config import curriculum
from hasrl_jax.config import schema as config_module
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import ConfigError

STAGES = ["1000 cassie.command.start_moving=0.6", "2e3 cassie.command.forward_m_s=[-0.3,1.0] ppo.clip=0.1"]


def test_settings_change_and_stay() -> None:
    config = config_module.from_dict({"stages": STAGES, "total_env_steps": 5000})
    first, second, third = curriculum.stages(config)
    assert (first.until_env_steps, second.until_env_steps, third.until_env_steps) == (1000, 2000, 5000)
    assert first.config == config
    assert second.config.cassie.command.start_moving == third.config.cassie.command.start_moving == 0.6
    assert second.config.ppo.clip == 0.2
    assert third.config.cassie.command.forward_m_s == (-0.3, 1.0)
    assert third.config.ppo.clip == 0.1


def test_a_short_run_ends_within_its_stages() -> None:
    config = config_module.from_dict({"stages": STAGES, "total_env_steps": 1500})
    assert [stage.until_env_steps for stage in curriculum.stages(config)] == [1000, 1500, 1500]


def test_without_stages_there_is_one() -> None:
    assert curriculum.stages(Config()) == [curriculum.Stage(Config(), Config().total_env_steps)]


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (["soon cassie.push.force_n=[0,1]"], r"stages\[0\]: got 'soon .*expected \"STEPS"),
        ([""], r"stages\[0\]: got ''; expected"),
        (["100"], r"stages\[0\]: got '100'; expected"),
        (["100 cassie.push.force_n"], r"stages\[0\]: got .*; expected"),
        (["100 network.hidden_size=4"], r"stages\[0\]: network.hidden_size cannot change during a run"),
        (["100 cassie.push.force=[0,1]"], r"stages\[0\]: config.cassie.push.force: unknown field"),
        (
            ["100 cassie.push.force_n=[5,1]"],
            r"cassie.push.force_n: got .* expected low <= high",
        ),
        (["100 ppo.clip=0.1", "100 ppo.clip=0.2"], r"stages\[1\]: begins at 100 .* expected more than 100"),
    ],
)
def test_what_is_refused(stages: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        curriculum.stages(config_module.from_dict({"stages": stages}))


def test_the_command_line_refuses_before_anything_starts(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("stages: ['100 ppo.klip=0.1']\n")
    with pytest.raises(ConfigError, match=r"stages\[0\]: config.ppo.klip: unknown field"):
        parse_train(["--config", str(file)])
