"""The benchmarks run from their command line and report what they promise; no figure is judged here."""

import itertools
import json
import math
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest
from PIL import Image

from hasrl_jax.bench import mjx, report, walking
from hasrl_jax.cli.bench import main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.mjx_engine import make_engine
from hasrl_jax.envs.registry import make_task
from hasrl_jax.learn import ppo

TINY = """
task: cartpole
physics: {timestep_s: 0.005, steps_per_env_step: 2, integrator: Euler}
network: {hidden_size: 8}
ppo: {epochs: 1}
"""


@pytest.fixture
def tiny(tmp_path: Path) -> str:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return str(path)


def test_a_name_that_is_none_is_refused_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["colector"])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: NAME: got 'colector'; expected one of collector, scaling")
    assert error.count("\n") == 1


def test_parity_measures_and_writes(tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    figures, table = tmp_path / "new" / "parity.json", tmp_path / "new" / "parity.md"
    arguments = ["--config", tiny, "--states", "4", "--horizons", "3", "1", "--double"]
    assert main(["parity", *arguments, "--json", str(figures), "--markdown", str(table)]) == 0
    written = json.loads(figures.read_text())
    assert written["bench"] == "parity"
    assert written["versions"].keys() >= {"jax", "mujoco", "mujoco-mjx"}
    assert written["figures"]["settings"]["precision"] == "float64"
    assert list(written["figures"]["horizons"]) == ["1", "3"]
    assert written["figures"]["horizons"]["1"]["observation"]["max"] < 1e-9
    assert table.read_text() in capsys.readouterr().out
    assert "| 1 environment step | 3 environment steps |" in table.read_text()


def test_mjx_measures_and_draws(tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture, caplog) -> None:
    figures, picture = tmp_path / "mjx.json", tmp_path / "new" / "mjx.png"
    arguments = ["--config", tiny, "--num-envs", "16", "--unroll-length", "4", "--rounds", "1"]
    assert main(["mjx", *arguments, "--json", str(figures), "--plot", str(picture)]) == 0
    output = capsys.readouterr().out
    assert "physics steps/s" in output
    assert "learner share" in output
    assert "made for accelerators" in caplog.text
    written = json.loads(figures.read_text())["figures"]
    assert written["devices"] == 8
    (cell,) = written["cells"]
    assert (cell["num_envs"], cell["steps_per_env"], cell["minibatch_trajectories"]) == (16, 4, 8)
    assert (cell["recompiles"], cell["contact_overflow"], cell["constraint_overflow"]) == (0, 0, 0)
    assert all(math.isfinite(value) for value in cell.values() if value is not None)
    assert cell["physics_share"] + cell["policy_share"] + cell["learner_share"] == pytest.approx(1.0)
    with Image.open(picture) as image:
        assert image.size[0] > image.size[1] > 300


def test_mjx_times_all_physics_steps_of_an_environment_step() -> None:
    config = from_dict({"task": "cartpole", "physics": {"steps_per_env_step": 2}})
    engine = make_engine(make_task(config), "jax", 10)
    start = jax.vmap(engine.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    action = 0.2 * jax.random.normal(jax.random.split(jax.random.PRNGKey(0), 1)[0], (1, 1))  # a device's only one
    expected = jax.vmap(partial(engine.advance, uniforms=jnp.zeros(0)))(start, jnp.repeat(action, 8, axis=0))
    found = mjx.physics_only(engine, ppo.make_mesh(), 1)(start)
    np.testing.assert_allclose(found, expected[0].qpos, atol=1e-7)
    assert np.abs(found - start.qpos).max() > 1e-4


def test_mjx_stops_where_the_memory_ends(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def cell(config: Config, *_: object) -> dict:
        if config.mjx.num_envs > 16:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return {"num_envs": config.mjx.num_envs, "env_steps_per_second": 1.0}

    monkeypatch.setattr(mjx, "measure_cell", cell)
    monkeypatch.setattr(mjx, "tables", lambda figures: str([cell["num_envs"] for cell in figures["cells"]]))
    assert main(["mjx", "--num-envs", "64", "16", "8"]) == 0
    assert "[8, 16]" in capsys.readouterr().out
    assert main(["mjx", "--num-envs", "64"]) == 1
    assert "64 environments do not fit" in capsys.readouterr().err


def test_schedules_measures_and_draws(tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    figures, picture = tmp_path / "schedules.json", tmp_path / "new" / "schedules.png"
    with open(tiny, "a") as file:
        file.write("collect: {num_workers: 2, envs_per_worker: 2, max_episode_steps: 20}\n")
    sizes = ["--total-env-steps", "512", "--env-steps-per-iteration", "128", "--unroll-length", "2"]
    sizes += ["--seeds", "2", "--iterations", "2", "--update-shares", "1", "--target", "1"]
    arguments = ["schedules", "--config", tiny, *sizes, "--json", str(figures), "--plot", str(picture)]
    assert main(arguments) == 0
    output = capsys.readouterr().out
    assert "2 of 2" in output and "update s (asleep)" in output
    written = json.loads(figures.read_text())["figures"]
    assert [(run["schedule"], run["seed"]) for run in written["runs"][:4]] == [
        *(("sync", 0), ("overlap", 0), ("decoupled", 0)),
        ("sync", 1),
    ]
    for run in written["runs"]:
        assert run["curve"][-1]["env_steps"] >= 512
        assert run["env_steps_to_target"] == 128
        assert run["policy_lag_max"] <= {"sync": 0, "overlap": 1, "decoupled": 4}[run["schedule"]]
    cells = {cell["schedule"]: cell for cell in written["hiding"]}
    assert cells["sync"]["ideal_seconds"] == pytest.approx(2 * cells["overlap"]["ideal_seconds"])
    with Image.open(picture) as image:
        assert image.size[0] > image.size[1] > 200


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="learner and workers need a core each")
def test_walking_trains_and_judges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """That it walks in the second look is made up, what is timed is not."""
    tiny = str(tmp_path / "tiny.yaml")
    Path(tiny).write_text(
        "network: {hidden_size: 8}\nppo: {epochs: 1, minibatch_trajectories: 16}\n"
        "collect: {envs_per_worker: 2, env_steps_per_iteration: 64, unroll_length: 4}\nevaluate: {episodes: 1}\n"
    )
    cores = os.sched_getaffinity(0)
    learners, workers = set(), set()
    update = ppo.Update.__call__

    def watched(self: ppo.Update, *arguments: Any) -> Any:
        learners.add(frozenset(os.sched_getaffinity(0)))
        children = [child for child in psutil.Process().children() if "hasrl_jax.collect.worker" in child.cmdline()]
        workers.update(frozenset(child.cpu_affinity()) for child in children)
        return update(self, *arguments)

    monkeypatch.setattr(ppo.Update, "__call__", watched)
    monkeypatch.setattr(walking, "play", lambda *_: [{"speed": 1.0, "share_up": 1.0, "error": next(errors)}])
    errors = itertools.cycle([0.3, 0.1])
    arguments = ["--config", tiny, "--seeds", "1", "--schedules", "sync", "decoupled", "--total-env-steps", "512"]
    figures = tmp_path / "walking.json"
    assert main(["walking", *arguments, "--every", "2", "--json", str(figures)]) == 0
    assert "1 of 1" in capsys.readouterr().out
    assert (learners, workers) == ({frozenset({min(cores)})}, {frozenset(cores - {min(cores)})})
    assert os.sched_getaffinity(0) == cores
    runs = json.loads(figures.read_text())["figures"]["runs"]
    assert [run["schedule"] for run in runs] == ["sync", "decoupled"]
    for run in runs:
        assert [look["iteration"] for look in run["looks"]] == [2, 4]
        assert run["env_steps_to_walking"] == run["looks"][1]["env_steps"] >= 256
        assert 0 < run["looks"][0]["seconds"] < run["seconds_to_walking"] < run["seconds"]


@pytest.mark.parametrize("finished", [0, 2])
def test_an_interrupted_walking_bench_keeps_the_runs_that_are_over(
    finished: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = "seconds_to_walking env_steps_to_walking iteration_seconds collect_seconds update_seconds wait_seconds"
    figures_of_a_run = dict.fromkeys((*names.split(), "policy_lag", "seconds", "env_steps"), 1.0)

    def take_turns(*_: Any) -> Iterator[dict[str, Any]]:
        for seed in range(finished):
            yield {"schedule": "sync", "seed": seed, **figures_of_a_run}
        raise KeyboardInterrupt

    monkeypatch.setattr(walking, "take_turns", take_turns)
    cores = os.sched_getaffinity(0)
    figures = tmp_path / "walking.json"
    status = main(["walking", "--json", str(figures)])
    assert os.sched_getaffinity(0) == cores
    assert status == (0 if finished else 130)
    assert bool(figures.read_text()) == bool(finished)
    if finished:
        assert [run["seed"] for run in json.loads(figures.read_text())["figures"]["runs"]] == [0, 1]


def test_who_stands_still_or_falls_does_not_walk() -> None:
    good = {"speed": 0.5, "share_up": 0.95, "error": 0.1}
    assert walking.is_walking([good, good], 0.9, 0.2)
    for bad in ({"share_up": 0.85}, {"error": 0.5}, {"error": None}):
        assert not walking.is_walking([good, good | bad], 0.9, 0.2)


def test_physics_is_itemised_and_every_way_is_held_against_plain_mujoco(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    file = tmp_path / "physics.json"
    assert main(["physics", "--num-envs", "9", "--rounds", "1", "--json", str(file)]) == 0
    assert "solving constraints" in capsys.readouterr().out
    written = json.loads(file.read_text())["figures"]
    parts = written["parts"]
    assert all(us >= 0 for us in parts["us"].values())
    assert sum(parts["us"].values()) >= parts["us_per_physics_step"] * 0.999
    assert parts["counts"]["constraint rows"] > 12  # two loops a leg, three rows each
    deviation = {cell["way"]: cell["deviation"] for cell in written["cells"]}
    same = ("the engine", "all sensors in every physics step", "islands", "no midphase", "no sensors (a bound)")
    assert [deviation[name] for name in same] == [0.0] * len(same)
    assert 0 < deviation["sparse Jacobian"] < 1e-9
    assert deviation["no contacts (a bound)"] > 1e-3


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["physics", "--num-envs", "0"], "--num-envs"),
        (["physics", "--rounds", "0"], "--rounds"),
        (["schedules", "--seeds", "0"], "--seeds"),
        (["walking", "--every", "0"], "--every"),
        (["walking", "--config", "cartpole"], "expected one that walks"),
        (["schedules", "--update-shares", "-1"], "--update-shares"),
        (["schedules", "--total-env-steps", "0"], "total_env_steps"),
        (["parity", "--states", "0"], "--states"),
        (["parity", "--horizons", "1", "0"], "--horizons"),
        (["parity", "--seed", "-1"], "--seed"),
        (["parity", "--solver-iterations", "0"], "physics.solver_iterations"),
        (["parity", "--double", "--impl", "warp"], "--double"),
        (["parity", "--config", "missing.yaml"], "missing.yaml"),
        (["mjx", "--num-envs", "8", "0"], "--num-envs"),
        (["mjx", "--num-envs", "12"], "mjx.num_envs"),
        (["mjx", "--rounds", "0"], "--rounds"),
        (["mjx", "--impl", "warp"], "mjx.impl"),
        (["mjx", "--plot", "/dev/null/figure.png"], "/dev/null"),
    ],
)
def test_bad_input_is_one_line_that_names_it(arguments: list[str], named: str, capsys: pytest.CaptureFixture) -> None:
    assert main(arguments) != 0
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert named in errors[0]


def test_default_numbers_are_powers_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(mjx.numbers(None)) == [8, 16]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert list(mjx.numbers(None))[:3] == [256, 512, 1024]
    assert list(mjx.numbers([64, 8, 64])) == [8, 64]


def test_tables_are_markdown_and_line_up() -> None:
    table = report.format_table(["name", "steps/s"], [["a", 12345.6], ["long", 0.1234]])
    assert table.splitlines()[1:] == ["| ---- | ------: |", "| a    |  12,346 |", "| long |   0.123 |"]
