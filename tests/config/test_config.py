"""What a configuration refuses, from YAML and from the command line, and what the shipped files state."""

import copy
import dataclasses
import pickle
import typing
from collections.abc import Iterator

import pytest

from hasrl_jax.cli import parsing as cli
from hasrl_jax.config import strict_yaml
from hasrl_jax.config.checks import check, numbers
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import CONFIG_FOLDER, load_yaml, shipped
from hasrl_jax.config.tasks import config_class
from hasrl_jax.errors import ConfigError

WALKING = config_class("cassie")
LIMITS = {name: limits for name, _, limits in numbers(from_dict({}))}


def numeric_fields(settings: type = WALKING, prefix: str = "") -> Iterator[str]:
    for name, hint in typing.get_type_hints(settings).items():
        if dataclasses.is_dataclass(hint):
            yield from numeric_fields(hint, f"{prefix}{name}.")
        elif {int, float} & {hint, *typing.get_args(hint)}:
            yield prefix + name


def test_every_numeric_field_has_limits():
    assert set(LIMITS) == set(numeric_fields())
    check(from_dict({}))


@pytest.mark.parametrize("name", LIMITS)
def test_no_field_accepts_a_value_outside_its_limits_or_nan(name):
    *groups, field = name.split(".")
    low, high = LIMITS[name]
    for wrong in (low - 1, high * 2 + 1, float("nan"), float("inf"), float("-inf")):
        groups_of_config = [from_dict({})]
        for group in groups:
            groups_of_config.append(getattr(groups_of_config[-1], group))
        is_range = isinstance(getattr(groups_of_config[-1], field), tuple)
        changed = dataclasses.replace(groups_of_config.pop(), **{field: (wrong, wrong) if is_range else wrong})
        for group in reversed(groups):
            changed = dataclasses.replace(groups_of_config.pop(), **{group: changed})
        with pytest.raises(ConfigError, match=rf"^{name}: got [^\n]*; expected [^\n]*$"):
            check(changed)


@pytest.mark.parametrize(
    "arguments",
    [
        "--cassie.randomize.mass-scale -1 1",
        "--cassie.randomize.mass-scale 0 0",
        "--cassie.randomize.mass-scale 1 0.5",
        "--cassie.randomize.sliding-friction -1 1",
        "--cassie.randomize.damping-scale -1 1",
        "--cassie.randomize.physics-rate-scale 0 0",
        "--cassie.randomize.physics-rate-scale -1 1",
        "--cassie.randomize.physics-rate-scale 1 100",
        "--cassie.randomize.physics-rate-scale 1 5 --cassie.randomize.enabled True",
        "--cassie.reward.scale nan",
        "--cassie.reward.velocity=-inf",
        "--network.initial-log-std nan",
        "--network.initial-log-std 1000",
        "--network.hidden-size 1000000000",
        "--ppo.policy-learning-rate inf",
        "--ppo.value_learning_rate inf",
        "--cassie.clock.swing-fraction -3",
        "--cassie.clock.max-swing-fraction 5",
        "--cassie.clock.cycle-per-speed-s -2",
        "--cassie.termination.max-tilt-deg -10",
        "--cassie.termination.max-tilt-deg 1000",
        "--cassie.termination.min-height-m 2",
        "--cassie.command.resample-s -1 1",
        "--seed 12345678901234567890123",
        "--seed " + "9" * 5000,
        "--total-env-steps 1" + "0" * 400,
        "--collect.max-episode-steps 100000000000000000000",
        "--collect.worker-timeout-s 0.001",
        "--collect.num-workers 5000",
        "--num_workers 5000",
        "--evaluate.episodes 1000000",
        "--task hopper",
        "--backend=tpu_pool",
        "--ppo.clip",
        "--ppo.clip wide",
        "--ppo.clip 0.1 0.2",
        "--cassie.command.forward-m-s 1",
        "--ppo.clop 1",
        "stray",
    ],
)
def test_an_override_that_cannot_work_is_one_line(arguments, capsys):
    option = arguments.partition(" ")[0].partition("=")[0].lstrip("-")
    named = option.replace("num_workers", "collect.num_workers") if option == "num_workers" else option
    with pytest.raises(ConfigError) as caught:
        cli.override(shipped("cassie_walk"), arguments.split(), "train")
    message = str(caught.value)
    if "0.1 0.2" not in arguments:
        assert named.replace("-", "_") in message.replace("-", "_")
    assert "\n" not in message
    assert "─" not in message and "│" not in message
    assert len(message) < 300
    assert capsys.readouterr() == ("", "")


def test_a_refusal_says_what_would_work():
    base = shipped("cassie_walk")
    with pytest.raises(ConfigError, match=r"^--ppo\.clop: unknown option; did you mean --ppo\.clip\?$"):
        cli.override(base, ["--ppo.clop=1"], "train")
    with pytest.raises(ConfigError, match=r"^--forward: unknown option; did you mean --cassie.command.forward-m-s\?$"):
        cli.override(base, ["--forward", "1"], "train")
    with pytest.raises(ConfigError, match=r"^--ppo.clip: got 'abc'; expected a number$"):
        cli.override(base, ["--ppo.clip", "abc"], "train")
    with pytest.raises(ConfigError, match=r"^--seed: got '1.5'; expected a whole number$"):
        cli.override(base, ["--seed", "1.5"], "train")
    with pytest.raises(ConfigError, match=r"^--ppo.clip: missing; expected a value$"):
        cli.override(base, ["--ppo.clip"], "train")
    with pytest.raises(ConfigError, match=r"^--cassie.push.force-n: missing; expected 2 values$"):
        cli.override(base, ["--cassie.push.force-n", "1"], "train")
    with pytest.raises(ConfigError, match=r"^got stray, which no option takes$"):
        cli.override(base, ["stray"], "train")
    with pytest.raises(ConfigError, match=r"^--backend: got 'gpu'; expected one of cpu_pool, ray, mjx$"):
        cli.override(base, ["--backend=gpu"], "train")
    with pytest.raises(ConfigError, match=r"^task: got 'hopper'; expected cassie, cartpole.*, or MODULE:NAME"):
        cli.override(base, ["--task", "hopper"], "train")
    with pytest.raises(ConfigError, match=r"^ppo\.clip: got 2\.0; expected 0\.001 to 0\.999$"):
        cli.override(base, ["--ppo.clip", "2"], "train")


def test_overrides_still_work(capsys):
    arguments = "--seed 3 --num-workers=2 --ppo.max_kl 0 --cassie.command.forward-m-s -1 0.5 --schedule overlap"
    config = cli.override(from_dict({}), [*arguments.split(), "--network.symmetric", "True"], "train")
    assert (config.seed, config.collect.num_workers, config.ppo.max_kl) == (3, 2, 0.0)
    assert (config.cassie.command.forward_m_s, config.schedule) == ((-1.0, 0.5), "overlap")
    assert config.network.symmetric
    with pytest.raises(SystemExit) as stopped:
        cli.override(from_dict({}), ["--help"], "train")
    assert not stopped.value.code
    assert "--ppo.clip" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["''", "false", "[]", "0", "seed", "{}\n---\n{}"])
def test_only_an_empty_file_means_the_defaults(text, tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"some\.yaml"):
        load_yaml(path)
    path.write_text("# nothing\n")
    assert load_yaml(path) == from_dict({})


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("seed: 1\nseed: 2", "seed is given twice"),
        ("ppo: {clip: 0.1, epochs: 2, clip: 0.2}", "clip is given twice"),
        ("ppo: {clip: 1" + "0" * 400 + "}", "ppo.clip"),
        ("seed: 1" + "0" * 5000, "not valid YAML"),
        ("seed: 0x" + "f" * 5000, "thousands of digits"),
        ("seed: 2020-13-45", "not valid YAML"),
        ("seed: " + "[" * 5000, "not valid YAML"),
        ("ppo: {clip: 1.0e+400}", "ppo.clip"),
        ("a: &a [1]\nb: *a", "aliases are not supported"),
        ("seed: !!bool yes please", "the tag tag:yaml.org,2002:bool is not supported"),
        ("seed: !!timestamp x", "the tag tag:yaml.org,2002:timestamp is not supported"),
        ('seed: !!int ""', "the tag tag:yaml.org,2002:int is not supported"),
        ('ppo: {clip: !!float ""}', "the tag tag:yaml.org,2002:float is not supported"),
        ("!!map [a]", "the tag tag:yaml.org,2002:map is not supported"),
        ("ppo: !!set [a]", "the tag tag:yaml.org,2002:set is not supported"),
        ("seed: !!python/object/apply:os.getcwd []", "is not supported"),
        ('run_dir: "a\\0b"', "run_dir: got"),
        ("run_dir: " + "x" * 5000, "run_dir: got"),
        ("ppo: {clip: \uff11e-1}", "ppo.clip: got"),
        ("task: " + "x" * 5000, "task: got"),
    ],
)
def test_odd_yaml_is_one_short_line(text, named, tmp_path):
    path = tmp_path / "config"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        check(load_yaml(path))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_the_paper_file_states_every_setting_of_the_published_run():
    stated = strict_yaml.parse((CONFIG_FOLDER / "paper.yaml").read_text())

    def missing(settings: type, values: dict, prefix: str) -> Iterator[str]:
        for name, hint in typing.get_type_hints(settings).items():
            if name not in values:
                yield prefix + name
            elif dataclasses.is_dataclass(hint):
                yield from missing(hint, values[name], f"{prefix}{name}.")

    for group in ("physics", "cassie", "network", "ppo"):
        assert not list(missing(typing.get_type_hints(WALKING)[group], stated[group], f"{group}."))
    reward = shipped("paper").cassie.reward
    weights = reward.foot_force, reward.foot_velocity, reward.orientation, reward.pelvis_motion, reward.velocity
    assert sum(weights) + reward.hip_roll + reward.torque_change + reward.action_change == pytest.approx(1.0)


def test_from_dict_refuses_numbers_that_are_not_finite():
    for wrong in (float("nan"), float("inf"), 10**400, "nan"):
        with pytest.raises(ConfigError, match=r"config\.ppo\.clip: got .*; expected a finite number"):
            from_dict({"ppo": {"clip": wrong}})


def test_a_configuration_goes_through_pickle_and_copy():
    stages = [{"at_env_steps": 9, "set": {"ppo.clip": 0.1}}]
    config = from_dict({"seed": 5, "cassie": {"push": {"force_n": [0, 10]}}, "stages": stages})
    assert pickle.loads(pickle.dumps(config)) == copy.deepcopy(config) == config


def test_a_page_of_aliases_does_not_unpack_to_gigabytes(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigError, match="aliases are not supported"):
        load_yaml(path)


def test_surrogates_in_a_path_are_refused():
    with pytest.raises(ConfigError, match=r"^run_dir: got"):
        check(from_dict({"run_dir": "\ud800"}))


def test_a_file_extends_another_group_by_group(tmp_path):
    (tmp_path / "base.yaml").write_text("extends: smoke\nseed: 4\nppo: {clip: 0.3, epochs: 7}\n")
    (tmp_path / "mine.yaml").write_text("extends: base.yaml\nppo: {epochs: 9}\n")
    mine = load_yaml(tmp_path / "mine.yaml")
    assert (mine.seed, mine.ppo.clip, mine.ppo.epochs) == (4, 0.3, 9)
    assert mine.network.hidden_size == shipped("smoke").network.hidden_size
    (tmp_path / "base.yaml").write_text("extends: mine.yaml\n")
    with pytest.raises(ConfigError, match=r"base.yaml.extends: got 'mine.yaml', which extends this file itself"):
        load_yaml(tmp_path / "mine.yaml")
    (tmp_path / "base.yaml").write_text("extends: 5\n")
    with pytest.raises(ConfigError, match=r"base.yaml.extends: got 5; expected a file, or a name in configs/"):
        load_yaml(tmp_path / "mine.yaml")


def test_a_shipped_file_is_named_from_anywhere_and_a_wrong_name_lists_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_yaml("smoke") == shipped("smoke")
    with pytest.raises(ConfigError, match=r"--config smok: cannot be read .*shipped are cartpole, .*smoke"):
        load_yaml("smok")
