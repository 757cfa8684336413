"""The scorecard: its rows, what each row plays, and a small one through the command line."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hasrl_jax.cli.evaluate import main as evaluate_main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.envs.cassie.commands import PUSH_UNIFORMS, draw_push, next_push
from hasrl_jax.envs.cassie.task import ASSET
from hasrl_jax.evaluate import rollout, scorecard
from hasrl_jax.evaluate.scorecard import Row
from hasrl_jax.policy.loading import load_baseline


def test_rows_cover_what_is_asked() -> None:
    rows = scorecard.rows(from_dict({}))
    assert len({(row.title, row.randomized) for row in rows}) == len(rows)
    for randomized in (False, True):
        speeds = {row.forward_m_s[0] for row in rows if row.kind == "speed" and row.randomized == randomized}
        assert speeds == {-1.0, -0.3, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0}
    assert {row.push_n for row in rows if row.kind == "push"} == {50, 100, 150, 200, 250, 300}
    hindered = {(row.disturbance, row.forward_m_s[0]) for row in rows if row.kind == "disturbance"}
    assert {("friction 0.4", 1.0), ("friction 0.2", 1.0), ("friction 0.4", 3.0), ("friction 0.2", 3.0)} <= hindered
    assert {name for name, _ in hindered} == {*scorecard.DISTURBANCES, *scorecard.GROUNDS}
    steered = scorecard.rows(shipped("cassie_steer"))
    assert steered[: len(rows)] == rows
    assert {row.kind for row in steered[len(rows) :]} == {"steering", "turn", "sidestep", "height"}


def test_a_disturbance_is_the_only_one() -> None:
    """The robot that a row of one disturbance draws differs from the nominal one in nothing else."""
    trained = shipped("cassie_steer")
    nominal = scorecard.make_task(scorecard.row_config(trained, Row("speed", (1.0, 1.0)), 20.0)).model
    changed = {
        "10 kg on the pelvis": {"body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0"},
        "torque limits x 0.8": {"actuator_forcerange"},
        "PD gains x 1.2": {"actuator_gainprm"},
        "friction 0.4": {"geom_friction"},
        "control delay 10 ms": set(),
        "noisy observations": set(),
        "velocity off by up to 0.2 m/s and 0.1 s late": set(),
        "heading drifts by up to 3 °/s": set(),
        "turned by 90° at the start": set(),
        "policy periods x 0.8 to 1.2": set(),
        "floor sloping by 8°": {"geom_quat"},
        "torque 3 ms late": {"actuator_dynprm"},
    }
    for name, fields in changed.items():
        task = scorecard.make_task(
            scorecard.row_config(trained, Row("disturbance", (1.0, 1.0), disturbance=name), 20.0)
        )
        drawn = task.reset(np.random.default_rng(0).random((2, task.reset_uniforms)), np).model_fields
        drawn.pop("timestep")
        differ = {
            field for field, values in drawn.items() if not np.allclose(values, getattr(nominal, field), rtol=1e-9)
        }
        assert differ == fields, name


def test_the_ground_of_a_row_is_the_only_thing_that_is_not_nominal() -> None:
    heights = {"ground uneven by ± 2 cm": (-0.02, 0.02), "a step up of 10 cm every 2 m": (0.1, 0.1)}
    for name, height in heights.items():
        row = Row("disturbance", (1.0, 1.0), disturbance=name)
        task = scorecard.make_task(scorecard.row_config(shipped("cassie_steer"), row, 20.0))
        fields = task.reset(np.random.default_rng(0).random((2, task.reset_uniforms)), np).model_fields
        differ = {field for field, found in fields.items() if field != "timestep"}
        differ = {field for field in differ if not np.allclose(fields[field], getattr(task.model, field), rtol=1e-9)}
        assert differ <= {"geom_pos", "geom_size", "bvh_aabb", "geom_friction"}
        ground = task.model.geom_bodyid == 0
        np.testing.assert_allclose(fields["geom_friction"][:, ~ground], task.model.geom_friction[None, ~ground][[0, 0]])
        rise = fields["geom_pos"][:, 1:3, 2] - fields["geom_pos"][:, :1, 2]  # of the first blocks above the start
        assert (rise > height[0] - 1e-9).all() and (rise < 2 * height[1] + 1e-9).all() and rise.any()


def test_a_row_of_steering_commands_all_dimensions() -> None:
    trained = shipped("cassie_steer")
    config = scorecard.row_config(trained, Row("steering", (-0.3, 4.0)), 60.0)
    task = scorecard.make_task(config)
    assert [command.drawn for command in task.commands] == [(-0.3, 4.0), (-0.5, 0.5), (-1.0, 1.0), (0.65, 1.0)]
    turn = scorecard.row_config(trained, Row("turn", (1.0, 1.0), yaw_rate_rad_s=-0.5), 60.0)
    assert [command.drawn for command in scorecard.make_task(turn).commands][2:] == [(-0.5, -0.5), (0.9, 0.9)]


def test_a_row_sets_the_task_and_keeps_the_policy_s_own_clock() -> None:
    trained = shipped("paper")
    config = scorecard.row_config(trained, Row("changing", (-0.3, 2.0), randomized=True), 60.0)
    assert config.cassie.clock == trained.cassie.clock
    assert config.network == trained.network
    assert config.cassie.command.forward_m_s == (-0.3, 2.0)
    assert config.cassie.command.resample_s == (2, 6)
    assert config.cassie.push.force_n == (0, 0)
    assert config.cassie.termination.min_height_m == 0.6
    assert config.collect.max_episode_steps == 2400
    push = scorecard.row_config(trained, Row("push", (1.0, 1.0), push_n=150.0), 60.0)
    assert push.cassie.push.force_n == (150, 150)
    assert push.collect.max_episode_steps == 488  # 6 s, up to 1 s more, the push, and 5 s to survive
    stairs = scorecard.row_config(shipped("cassie_stairs"), Row("speed", (1.0, 1.0)), 60.0)
    assert stairs.cassie.terrain.kind == "flat"


def test_an_episode_meets_one_push() -> None:
    config = scorecard.row_config(from_dict({}), Row("push", (1.0, 1.0), push_n=150.0), 60.0)
    settings, step_s = config.cassie.push, config.physics.env_step_s
    rng = np.random.default_rng(0)
    push, push_s = draw_push(rng.random((200, PUSH_UNIFORMS)), settings, np)
    pushed = []
    for _ in range(config.collect.max_episode_steps):
        push, push_s = next_push(push, push_s, np.full(200, step_s), rng.random((200, PUSH_UNIFORMS)), settings, np)
        pushed.append((push_s <= 0) & (push_s > -settings.duration_s))
    begins = np.diff(np.array(pushed).astype(int), axis=0, prepend=0) > 0
    np.testing.assert_array_equal(begins.sum(axis=0), 1)


def test_pushed_episodes_are_those_up_at_the_push() -> None:
    row = Row("push", (1.0, 1.0), push_n=150.0)
    nothing = np.full(4, np.nan)
    part = {
        "seconds": np.array([2.0, 7.5, 12.2, 12.2]),
        "reached_cap": np.array([False, False, True, True]),
        "diverged": np.zeros(4, bool),
        "forward_speed": nothing,
    }
    summary = scorecard.summarize_row(row, scorecard.row_config(from_dict({}), row, 60.0), [part])
    assert summary["pushed_episodes"] == 3
    np.testing.assert_allclose(summary["share_up"]["mean"], 2 / 3)
    assert summary["forward_speed"]["mean"] is None


def test_a_zero_policy_never_acts() -> None:
    config, parameters = load_baseline("zero", from_dict({}))
    assert not any(array.any() for name, array in parameters.items() if name.startswith("policy/lstm"))
    episodes = rollout.run_episodes(config, scorecard.make_task(config), parameters, 2, 0)
    assert (episodes.seconds < 3).all()
    _, random = load_baseline("random", from_dict({}))
    assert random["policy/lstm_0_input"].any()


def test_a_small_scorecard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = [Row("speed", (0.0, 0.0)), Row("speed", (1.0, 1.0)), Row("push", (1.0, 1.0), push_n=50.0)]
    few += [Row("speed", (0.0, 0.0), randomized=True)]
    monkeypatch.setattr(scorecard, "rows", lambda _: few)
    monkeypatch.setattr(scorecard, "BATCH", 2)
    arguments = ["--policy", "released", "--scorecard", str(tmp_path), "--episodes", "3", "--seconds", "4"]
    assert evaluate_main([*arguments, "--physics", "training", "--against", "zero"]) == 0
    report = json.loads((tmp_path / "scorecard.json").read_text())
    assert list(report["policies"]) == ["the released policy", "zero"]
    rows = report["policies"]["the released policy"]
    assert [row["title"] for row in rows] == [row.title for row in few]
    assert all(row["episodes"] == 3 for row in rows)
    assert rows[1]["share_up"]["mean"] == 1.0
    assert 0.8 < rows[1]["forward_speed"]["mean"] < 1.2
    assert report["policies"]["zero"][0]["share_up"]["mean"] == 0.0
    page = (tmp_path / "scorecard.md").read_text()
    assert "| 1 m/s | 100 %" in page
    assert "### zero" in page
    assert (tmp_path / "scorecard.png").stat().st_size > 10_000


def test_another_model_is_added_to_a_card_and_stays_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = [Row("speed", (0.0, 0.0))]
    monkeypatch.setattr(scorecard, "rows", lambda _: few)
    monkeypatch.setattr(
        scorecard, "model_rows", lambda: [Row("speed", (1.0, 1.0)), Row("push", (1.0, 1.0), push_n=50.0)]
    )
    monkeypatch.setattr(scorecard, "MODEL_EPISODES", 2)
    monkeypatch.setattr(scorecard, "SHORT_S", 4.0)
    whole = ["--policy", "released", "--scorecard", str(tmp_path), "--physics", "training"]
    card = [*whole, "--episodes", "2", "--seconds", "4"]
    assert evaluate_main(card) == 0
    before = json.loads((tmp_path / "scorecard.json").read_text())
    other = tmp_path / "other" / "robot.xml"
    other.parent.mkdir()
    other.write_text(ASSET.read_text().replace('mass="10.33"', 'mass="100"'))  # more than it can carry
    assert evaluate_main([*whole, "--model", str(other)]) == 0
    after = json.loads((tmp_path / "scorecard.json").read_text())
    assert after["policies"] == before["policies"]
    found = after["models"]["other/robot.xml"]
    assert [row["episodes"] for row in found["rows"]] == [2, 2]
    assert before["policies"]["the released policy"][0]["share_up"]["mean"] == 1.0
    assert found["rows"][0]["share_up"]["mean"] == 0.0
    page = (tmp_path / "scorecard.md").read_text()
    section = page[page.index("### other/robot.xml") :]
    assert "| 1 m/s | 0 % (0–66) |" in section and "| 1 m/s | – |" in section[section.index("50 N") :]
    assert evaluate_main(card) == 0  # what is there is not measured again
    assert json.loads((tmp_path / "scorecard.json").read_text())["models"] == after["models"]


def test_a_model_needs_a_card_to_be_added_to(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert evaluate_main(["--scorecard", str(tmp_path), "--model", str(ASSET)]) == 2
    assert "holds no scorecard; expected one made without --model" in capsys.readouterr().err
    assert evaluate_main(["--scorecard", str(tmp_path), "--model", str(ASSET), "--against", "zero"]) == 2
    assert "--against: a scorecard compares policies on their own model" in capsys.readouterr().err


def test_a_card_that_is_interrupted_keeps_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: object) -> Iterator[dict]:
        yield {"title": "", "randomized": False, "share_up": {"mean": None}}
        raise KeyboardInterrupt

    zero, random = load_baseline("zero", from_dict({})), load_baseline("random", from_dict({}))
    digest = scorecard._digest(*zero, seconds=4.0)
    report = {"episodes": 3, "seconds": 4.0, "seed": 0, "digests": {"zero": digest}, "policies": {"zero": ["a row"]}}
    (tmp_path / "scorecard.json").write_text(json.dumps(report))
    monkeypatch.setattr(scorecard, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        scorecard.write(tmp_path, {"zero": zero, "random": random}, 3, 4.0, 0, "")
    kept = json.loads((tmp_path / "scorecard.json").read_text())["policies"]
    assert kept["zero"] == ["a row"]
    assert len(kept["random"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scorecard", "DIR", "--json", "x.json"], "--scorecard: writes its own files"),
        (["--against", "zero"], "--against: only a --scorecard or --stairs compares policies"),
        (["--cassie.command.forward-m-s", "0", "3"], "--forward: got 3; the policy was trained for -0.3 to 2 m/s"),
        (["--scorecard", "DIR", "--against", "nobody"], "nobody"),
        (["--scorecard", "DIR", "--seconds", "2"], "--seconds: got 2; expected at least 4"),
        (["--scorecard", "DIR", "--cassie.push.force-n", "0", "9"], "--cassie.push.force-n: a scorecard sets it"),
    ],
)
def test_bad_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    arguments = [str(tmp_path / "card") if argument == "DIR" else argument for argument in arguments]
    assert evaluate_main(["--policy", "released", *arguments]) != 0
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
