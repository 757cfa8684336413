"""UniLab in `bench compare`, without UniLab: what is read of its output, what is put in its place, what is refused."""

import sys
from pathlib import Path

import mujoco
import pytest

from hasrl_jax.bench import compare_unilab
from hasrl_jax.bench.compare_unilab import Iteration
from hasrl_jax.cli.bench import main
from hasrl_jax.errors import ConfigError, WorkerError

TABLE = """
                      Learning iteration 7/12
                       Total steps: 49152
                  Steps per second: 2790
                   Collection time: 1.503s
                     Learning time: 0.699s
                 Mean action noise: 0.97
                   Collection time: 1.600s
                     Learning time: 0.700s
"""
LINE = "Computation: 2800 steps/s (collection: 1.250s, learning 0.750s)"
PACKAGE = """
<mujoco model="standing">
  <asset>{meshes}</asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 1"><freejoint/><geom type="mesh" mesh="one"/></body>
  </worldbody>
</mujoco>
"""


def test_times_are_read_from_both_kinds_of_output() -> None:
    assert compare_unilab.parse(TABLE) == [Iteration(1.503, 0.699), Iteration(1.6, 0.7)]
    assert compare_unilab.parse(LINE) == [Iteration(1.25, 0.75)]


def test_shares_are_of_its_own_limit() -> None:
    found = compare_unilab.shares(collecting=400.0, end_to_end=300.0, bound=1000.0)
    assert (found["collecting_share"], found["end_to_end_share"]) == (0.4, 0.3)


def test_missing_meshes_are_stood_in_for_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "package"
    robot = package / compare_unilab.ROBOT
    robot.mkdir(parents=True)
    meshes = '<mesh name="one" file="one.STL"/><mesh name="two" file="two.STL"/>'
    (robot / "g1.xml").write_text(
        PACKAGE.format(meshes=meshes).replace("<asset>", '<compiler meshdir="assets"/><asset>')
    )
    (robot / "assets").mkdir()
    (robot / "assets" / "two.STL").write_bytes(compare_unilab.tetrahedron(0.5))
    monkeypatch.setattr(compare_unilab, "ask", lambda python, code: str(package))
    copied = compare_unilab.prepare(Path(sys.executable), tmp_path / "work") / compare_unilab.ROBOT
    assert copied == tmp_path / "work" / "src" / "unilab" / compare_unilab.ROBOT
    model = mujoco.MjModel.from_xml_path(str(copied / "g1.xml"))
    assert model.nmesh == 2 and model.mesh("two").vertnum[0] == 4
    assert (copied / "assets" / "two.STL").read_bytes() == compare_unilab.tetrahedron(0.5)
    assert not (robot / "assets" / "one.STL").exists()  # the package itself stays as it is


def test_an_interpreter_without_it_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["compare", "--peers", "--unilab", str(tmp_path / "python")]) == 2
    assert capsys.readouterr().err.startswith("error: --unilab: got ")
    with pytest.raises(ConfigError, match="unilab"):
        compare_unilab.version_of(Path(sys.executable))


def test_a_training_that_prints_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorkerError, match="status 1"):  # this interpreter has no such package
        compare_unilab.train(Path(sys.executable), tmp_path, 1, 1)


def test_the_limit_steps_a_model(tmp_path: Path) -> None:
    robot = tmp_path / compare_unilab.ROBOT
    robot.mkdir(parents=True)
    (robot / "scene_flat.xml").write_text(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody>'
        '<keyframe><key qpos="0 0 1 1 0 0 0"/></keyframe></mujoco>'
    )
    assert compare_unilab.limit(Path(sys.executable), tmp_path, processes=2, seconds=0.01) > 0
    (robot / "scene_flat.xml").write_text("<nothing/>")
    with pytest.raises(WorkerError, match="status 1"):
        compare_unilab.limit(Path(sys.executable), tmp_path, processes=1, seconds=0.01)
