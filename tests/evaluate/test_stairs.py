"""Trials on stairs: what a row plays, where a trial succeeds, and a small page through the command line."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hasrl_jax.cli.evaluate import main as evaluate_main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.registry import make_task
from hasrl_jax.evaluate import scorecard, stairs
from hasrl_jax.evaluate.stairs import Row
from hasrl_jax.policy import loading


def test_rows_cover_speeds_heights_and_other_ground() -> None:
    rows = stairs.rows()
    assert len({row.title for row in rows}) == len(rows)
    for way in ("up", "down"):
        plain = [row for row in rows if row.ground == way and not row.randomized]
        assert {row.speed_m_s for row in plain if row.rise_m == 0.15} == {0.25, 0.5, 0.75, 1.0, 1.25, 1.5}
        assert {row.rise_m for row in plain if row.speed_m_s == 0.75} == {0.05, 0.1, 0.125, 0.15, 0.175, 0.2}
        assert len([row for row in rows if row.ground == way and row.randomized]) == 1
    assert {row.ground for row in rows} == {"up", "down", "level", "slopes", "rough", "step down"}


def test_a_row_sets_the_ground_and_leaves_what_the_policy_sees() -> None:
    other = {"motor": {"torque_speed_curve": False}, "push": {"force_n": [50, 90]}, "terrain": {"level_share": 0.5}}
    trained = from_dict({"cassie": other}, shipped("cassie_stairs"))
    config = stairs.row_config(trained, Row("down", 0.5, 0.2))
    assert config.cassie.motor.torque_speed_curve
    assert (config.cassie.push.force_n, config.cassie.terrain.level_share) == ((0.0, 0.0), 0.0)
    assert config.cassie.observe == "blind" and config.cassie.clock == trained.cassie.clock
    assert config.cassie.terrain.step_height_m == (-0.2, -0.2) and config.cassie.terrain.steps == (1, 8)
    assert config.cassie.command.forward_m_s == (0.5, 0.5)
    assert not config.cassie.randomize.enabled
    longest_m = 1.0 + 1.5 + 8 * 0.4 + 0.5
    assert config.collect.max_episode_steps * 0.025 > longest_m / 0.5
    assert stairs.row_config(trained, Row("up", randomized=True)).cassie.randomize.mass_scale == (0.5, 1.5)
    for ground in stairs.OTHERS:
        make_task(stairs.row_config(trained, Row(ground)))


@pytest.mark.parametrize("row", [Row("up"), Row("down"), Row("slopes")])
def test_a_trial_succeeds_on_the_landing(row: Row) -> None:
    """The landing from the height of the ground itself: where it stops rising or falling for more than two meters."""
    config = stairs.row_config(shipped("cassie_stairs"), row)
    task = make_task(config)
    envs = CpuEnvs(task, 30, 10)
    state = envs.reset(np.random.default_rng(0))
    x = np.arange(0.0, 12.0, 1e-2)
    for env in range(30):
        ground = state.task.terrain[env]
        table = np.broadcast_to(ground, (len(x), *ground.shape))
        height = stairs.terrain.height_at(x, table, np)
        edges = x[np.flatnonzero(np.diff(height))]
        end = edges[0] + 4.0 if row.ground == "slopes" else edges[np.argmax(np.diff(edges) > 2.0)] + 0.5
        for place, expected in ((end - 0.05, False), (end + 0.05, True)):
            physics = state.physics.copy()
            physics[:, 1] = place
            assert stairs.arrived(row, state._replace(physics=physics))[env] == expected


def test_a_small_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = [Row("level"), Row("up", 0.75, 0.15)]
    monkeypatch.setattr(stairs, "rows", lambda: few)
    arguments = ["--policy", "released-stairs", "--stairs", str(tmp_path), "--episodes", "3", "--against", "zero"]
    assert evaluate_main([*arguments, "--physics", "training"]) == 0
    report = json.loads((tmp_path / "stairs.json").read_text())
    assert list(report["policies"]) == ["released-stairs", "zero"]
    shares = {name: [row["success"] for row in found["rows"]] for name, found in report["policies"].items()}
    assert shares["released-stairs"][0]["mean"] == 1.0 and shares["zero"][0]["mean"] == 0.0
    # Wilson, 3 of 3: 3 / (3 + 1.96^2).
    np.testing.assert_allclose(shares["released-stairs"][0]["low"], 3 / (3 + 1.96**2))
    page = (tmp_path / "stairs.md").read_text()
    assert "| trial | released-stairs | zero |" in page
    assert "| level, 0.75 m/s | 100 % (44–100) | 0 % (0–56) |" in page
    assert (tmp_path / "stairs.png").stat().st_size > 10_000

    def nothing(*_: object) -> list[object]:
        raise AssertionError("measured again")

    monkeypatch.setattr(scorecard, "_play", nothing)
    monkeypatch.setattr(stairs, "play", nothing)
    assert evaluate_main([*arguments, "--physics", "training"]) == 0
    assert json.loads((tmp_path / "stairs.json").read_text())["policies"] == report["policies"]


def test_trials_are_added_and_what_cannot_be_read_is_measured_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = []

    def play(_: object, jobs: list) -> Iterator[np.ndarray]:
        """All succeed in the first batch, none later."""
        for _, _, _, trials, seed in jobs:
            measured.append((trials, seed))
            yield np.full(trials, seed[-1] == 0)

    monkeypatch.setattr(stairs, "rows", lambda: [Row("level")])
    monkeypatch.setattr(stairs, "in_processes", play)
    policies = {"zero": loading.load_baseline("zero", from_dict({}))}
    (tmp_path / "stairs.json").write_text('{"policies": {"zero": ')  # cut short

    def success(trials: int, seed: int) -> float:
        stairs.write(tmp_path, policies, trials, seed, "")
        (row,) = json.loads((tmp_path / "stairs.json").read_text())["policies"]["zero"]["rows"]
        assert row["trials"] == trials
        return row["success"]["mean"]

    assert (success(3, 0), measured) == (1.0, [(3, [0, 0, 0])])
    assert (success(3, 0), len(measured)) == (1.0, 1)  # they are known
    assert (success(50, 0), measured[1:]) == (0.5, [(25, [0, 0, 0]), (25, [0, 0, 25])])  # 3 are no batch
    assert (success(75, 0), measured[3:]) == (pytest.approx(25 / 75), [(25, [0, 0, 50])])
    assert (success(50, 0), len(measured)) == (0.5, 6)  # which 50 of the 75 it were is not known
    assert (success(50, 1), len(measured)) == (0.5, 8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--json", "x.json"], "--stairs: writes its own files"),
        (["--seconds", "9"], "--stairs: plays trials of its own; leave out --seconds"),
        (["--cassie.terrain.kind", "flat"], "--cassie.terrain.kind: the page about stairs sets it"),
        (["--against", "nobody"], "nobody"),
    ],
)
def test_bad_arguments(arguments: list[str], message: str, capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    assert evaluate_main(["--policy", "released", "--stairs", str(tmp_path / "page"), *arguments]) != 0
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1


def test_the_policy_of_an_earlier_configuration_still_loads() -> None:
    config, _ = loading.load_policy_parameters(None, "released")
    settings = config.settings
    assert (settings.observe, settings.terrain.kind, settings.terrain.steps) == ("state", "flat", (8, 8))
    assert (settings.terrain.step_noise_m, settings.terrain.average_m, config.network.memory) == (0.0, 0.0, "lstm")
