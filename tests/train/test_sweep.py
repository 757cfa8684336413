"""Sweeps: proposed, trained, pruned, resumed, shown."""

import json
import re
from pathlib import Path

import pytest
from tiny import tiny_yaml

from hasrl_jax.cli import sweep
from hasrl_jax.cli.main import main
from hasrl_jax.visualize.sweep_page import Trial, page

optuna = pytest.importorskip("optuna")

TINY = tiny_yaml(collect={"num_workers": 1}, evaluate={"every_iterations": 0}, total_env_steps=256)
SPACE = (
    "ppo.clip: {uniform: [0.1, 0.3]}\nppo.policy_learning_rate: {log: [1.0e-5, 1.0e-2]}\nppo.epochs: {choice: [1, 2]}\n"
)


def test_a_sweep_trains_its_trials_and_goes_on_where_it_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY)
    (tmp_path / "space.yaml").write_text(SPACE)
    out = tmp_path / "sweep"
    arguments = ["--space", str(tmp_path / "space.yaml"), "--out", str(out), "--config", str(tmp_path / "tiny.yaml")]
    assert main(["sweep", *arguments, "--trials", "1"]) == 0, capsys.readouterr().err
    assert main(["sweep", *arguments, "--trials", "2"]) == 0, capsys.readouterr().err
    study = optuna.load_study(study_name="sweep", storage=f"sqlite:///{out / 'study.db'}")
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "COMPLETE"]
    for trial in study.trials:
        run = out / f"trial_{trial.number:04d}"
        records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        returns = [record["episode_return_train"] for record in records if record["episode_return_train"] is not None]
        assert trial.value == pytest.approx(sum(returns) / len(returns))
        trained_with = (run / "config.yaml").read_text()
        assert float(re.search(r"clip: (\S+)", trained_with).group(1)) == trial.params["ppo.clip"]
    text = (out / "sweep.html").read_text()
    assert f"{study.best_value:.4g}" in text and "trial_0001" in text


class Stubborn:
    """A trial that is to be pruned as soon as it has reported twice."""

    def __init__(self) -> None:
        self.reports: list[tuple[float, int]] = []

    def report(self, value: float, step: int) -> None:
        self.reports.append((value, step))

    def should_prune(self) -> bool:
        return len(self.reports) > 1


def test_a_pruned_trial_is_stopped_and_can_be_continued(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY.replace("total_env_steps: 256", "total_env_steps: 100000000"))
    trial, states = Stubborn(), optuna.trial.TrialState
    outcome = sweep.train_trial(
        ["--config", str(tmp_path / "tiny.yaml")], tmp_path / "run", trial, "episode_return_train", states
    )
    assert outcome == (states.PRUNED, None)
    assert "finishing this iteration, then saving" in (tmp_path / "run.log").read_text()
    assert [iteration for _, iteration in trial.reports] == sorted({iteration for _, iteration in trial.reports})


def test_a_sweep_whose_trials_fail_again_and_again_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    states = optuna.trial.TrialState
    outcomes = iter([(states.COMPLETE, 1.0), (states.FAIL, None), (states.COMPLETE, 2.0), *3 * [(states.FAIL, None)]])
    monkeypatch.setattr(sweep, "train_trial", lambda *_: next(outcomes))
    (tmp_path / "space.yaml").write_text("ppo.clip: {uniform: [0.1, 0.3]}\n")
    out = tmp_path / "sweep"
    assert main(["sweep", "--space", str(tmp_path / "space.yaml"), "--out", str(out), "--trials", "9"]) == 1
    assert f"{out / 'trial_0005'}: 3 trials in a row failed" in capsys.readouterr().err
    assert next(outcomes, None) is None


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("ppo.clip: {uniform: [0.3, 0.1]}", "ppo.clip: got .*; expected one of uniform, log, int, choice with"),
        ("ppo.clip: 0.1", "ppo.clip: got 0.1; expected one of"),
        ("[1]", "expected fields, as in ppo.clip"),
        ("ppo.clop: {uniform: [0.1, 0.2]}", "--ppo.clop: unknown option; did you mean --ppo.clip"),
        ("ppo.clip: {uniform: [0.1, 7]}", r"ppo.clip: got 7.*; expected 0.001 to 0.999"),
    ],
)
def test_an_impossible_space_is_refused_before_anything_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], space: str, message: str
) -> None:
    (tmp_path / "space.yaml").write_text(space)
    assert main(["sweep", "--space", str(tmp_path / "space.yaml"), "--out", str(tmp_path / "sweep")]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1
    assert not (tmp_path / "sweep").exists()


def test_the_page_shows_the_best_first() -> None:
    trials = [
        Trial(0, "complete", 1.0, {"ppo.clip": 0.1}, "trial_0000"),
        Trial(1, "pruned", 9.0, {"ppo.clip": 0.2}, "trial_0001"),
        Trial(2, "complete", 3.0, {"ppo.clip": 0.3}, "trial_0002"),
    ]
    high, low = page("episode_return_train", True, trials), page("kl", False, trials)
    assert "Best of 2: trial 2, 3: <code>--ppo.clip 0.3</code>" in high
    assert high.index("trial_0002") < high.index("trial_0000") < high.index("trial_0001")
    assert "Best of 2: trial 0, 1: " in low
