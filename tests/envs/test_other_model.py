"""The task on another MJCF file of the robot: the same physics under other names is the same task."""

import pickle
import sys
import types
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from hasrl_jax.cli.evaluate import main as evaluate_main
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import shipped
from hasrl_jax.envs.cassie import other_model
from hasrl_jax.envs.cassie.task import ASSET
from hasrl_jax.envs.cpu_engine import CpuEnvs
from hasrl_jax.envs.gymnasium import TaskEnv
from hasrl_jax.envs.registry import MENAGERIE, Robot, make_task, make_task_on
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy.loading import load_baseline
from hasrl_jax.visualize.viewer.live import Live

RENAMED = {
    "joints": {"left-knee": "KneeL", "right-achilles-rod": "RodR"},
    "bodies": {"left-foot": "toe_left"},
    "sites": {"imu": "vectornav"},
    "sensors": {"pelvis-acceleration": "accelerometer"},
}
# Bodies and closures that are called like a joint that has another name, and the joint that is called like a body.
KEPT = {
    ("body", "left-knee"),
    ("body", "right-achilles-rod"),
    ("connect", "right-achilles-rod"),
    ("joint", "left-foot"),
}


def other_file(folder: Path, *, accelerometer: bool = True, floor: bool = True) -> Path:
    """Our robot as somebody else might have written it: a free joint, torque motors, few sensors, other names.

    A light lid on a stiff joint comes before the legs, so that numbers stand elsewhere.
    """
    tree = ElementTree.parse(ASSET)
    root = tree.getroot()
    for name in ("actuator", "sensor", "keyframe"):
        root.remove(root.find(name))
    pelvis = root.find("worldbody/body")
    for joint in pelvis.findall("joint"):
        pelvis.remove(joint)
    pelvis.insert(1, ElementTree.Element("freejoint"))
    pelvis.set("pos", "0 0 1.3")  # where nobody stands
    lid = ElementTree.Element("body", name="lid", pos="0 0 0.15")
    ElementTree.SubElement(lid, "inertial", pos="0 0 0", mass="1e-5", diaginertia="1e-7 1e-7 1e-7")
    ElementTree.SubElement(lid, "joint", name="lid", type="hinge", axis="1 0 0", stiffness="10", damping="0.1")
    pelvis.insert(3, lid)
    renamed = [pair for pairs in RENAMED.values() for pair in pairs.items()]
    for element in root.iter():
        for ours, theirs in renamed if element.tag in ("joint", "body", "site", "connect") else ():
            for key in ("name", "body1", "body2"):
                if element.get(key) == ours and (element.tag, ours) not in KEPT:
                    element.set(key, theirs)
        for site in element.findall("site"):
            if site.get("name").endswith("sole"):
                element.remove(site)
    motors = ElementTree.SubElement(root, "actuator")
    ElementTree.SubElement(motors, "motor", name="left-knee", joint="KneeL", gear="16", ctrlrange="-12 12")
    sensors = ElementTree.SubElement(root, "sensor")
    ElementTree.SubElement(sensors, "actuatorpos", name="drive", actuator="left-knee")
    if accelerometer:
        ElementTree.SubElement(sensors, "accelerometer", name="accelerometer", site="vectornav")
    if not floor:
        root.find("worldbody").remove(root.find("worldbody/geom[@name='floor']"))
    path = folder / "robot.xml"
    tree.write(path)
    return path


def mapping_file(folder: Path, mapping: dict) -> Path:
    path = folder / "mapping.yaml"
    lines = [f"{group}: {{{', '.join(f'{a}: {b}' for a, b in pairs.items())}}}" for group, pairs in mapping.items()]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("randomized", [False, True])
def test_the_same_robot_under_other_names_moves_alike(tmp_path, randomized):
    changes = {"cassie": {"randomize": {"enabled": randomized, "mass_scale": [1, 1]}, "push": {"force_n": [50, 50]}}}
    config = from_dict(changes, shipped("paper"))
    ours = make_task(config)
    theirs = make_task_on(config, Robot(other_file(tmp_path), mapping_file(tmp_path, RENAMED)))
    assert theirs.model.nq == ours.model.nq + 1
    assert theirs.model.nu == 10
    assert theirs.model.nsensor == ours.model.nsensor
    rng = np.random.default_rng(0)
    # The mass draws of the bodies differ in number; nothing else does.
    shared = rng.random((2, ours.reset_uniforms))
    bodies, damping = ours.model.nbody - 1, 18
    longer = np.concatenate(
        [shared[:, : damping + bodies], np.full((2, 1), 0.5), shared[:, damping + bodies :]], axis=1
    )
    assert longer.shape[1] == theirs.reset_uniforms

    observations = []
    for task, uniforms in ((ours, shared), (theirs, longer)):
        envs = CpuEnvs(task, 2, 1000)
        state = envs.reset(_Given(uniforms))
        seen, actions = [state.observation], np.random.default_rng(1)
        for _ in range(12):
            action = 0.2 * actions.standard_normal((2, 10))
            state, result = envs.step(state, action, np.random.default_rng(2))
            assert not result.diverged.any()
            seen.append(result.final_observation)
            seen.append(np.concatenate([result.measures, result.reward[:, None]], axis=1))
        observations.append(np.concatenate(seen, axis=1))
    assert np.abs(observations[0]).max() > 1
    # The lid weighs a little.
    np.testing.assert_allclose(observations[1], observations[0], atol=1e-3, rtol=0)


class _Given:
    """A generator that gives the same numbers each time, however many are asked for."""

    def __init__(self, uniforms):
        self.uniforms = uniforms

    def random(self, shape):
        assert shape == self.uniforms.shape
        return self.uniforms


def test_joints_start_in_our_pose_wherever_they_stand(tmp_path):
    task = make_task_on(shipped("cassie_walk"), Robot(other_file(tmp_path), mapping_file(tmp_path, RENAMED)))
    pose, model = task.model.key("stand").qpos, task.model
    assert pose[model.joint("KneeL").qposadr[0]] == pytest.approx(-1.1997)
    assert pose[model.joint("right-foot").qposadr[0]] == pytest.approx(-1.5968)
    assert pose[model.joint("lid").qposadr[0]] == 0
    assert model.joint("left-hip-roll").qposadr[0] == 8  # ours is at 7
    np.testing.assert_allclose(
        pose[model.joint("RodR").qposadr[0] :][:4], [0.9786, 0.00386, -0.01524, -0.2051], atol=1e-4
    )


@pytest.mark.parametrize(
    ("mapping", "complaint"),
    [
        ({}, "among its joints there is no left-knee; name ours, left-knee, with --mapping"),
        ({**RENAMED, "sites": {"imu": "IMU"}}, "among its sites there is no IMU; name ours, imu"),
        ({**RENAMED, "sensors": {"pelvis-acceleration": "a"}}, "among its sensors there is no a; name ours"),
        ({**RENAMED, "motors": {}}, "--mapping: got the group 'motors'; expected joints, bodies, sites, sensors"),
        ({**RENAMED, "bodies": {"foot": "toe"}}, "--mapping: bodies: got 'foot': 'toe'; expected one of our names"),
    ],
)
def test_what_is_missing_is_named(tmp_path, mapping, complaint):
    with pytest.raises(ConfigError, match=complaint):
        make_task_on(shipped("cassie_walk"), Robot(other_file(tmp_path), mapping_file(tmp_path, mapping)))


def test_files_that_cannot_be_played_on_are_refused(tmp_path):
    config, mapping = shipped("cassie_walk"), mapping_file(tmp_path, RENAMED)
    with pytest.raises(ConfigError, match="it has no ground; expected a scene with a floor"):
        make_task_on(config, Robot(other_file(tmp_path, floor=False), mapping))
    without = {**RENAMED, "sensors": {}}
    assert make_task_on(config, Robot(other_file(tmp_path, accelerometer=False), mapping_file(tmp_path, without)))
    stairs = from_dict({"cassie": {"terrain": {"kind": "steps"}}}, config)
    with pytest.raises(ConfigError, match=r"cassie.terrain.kind: got steps; expected flat with a --model"):
        make_task_on(stairs, Robot(other_file(tmp_path), mapping))
    with pytest.raises(ConfigError, match="there is no such file"):
        make_task_on(config, Robot(tmp_path / "nothing.xml"))
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    with pytest.raises(ConfigError, match="not an MJCF file that compiles"):
        make_task_on(config, Robot(broken))
    with pytest.raises(ConfigError, match="a policy for task cartpole is played on its own model only"):
        make_task_on(shipped("cartpole"), Robot(broken))
    (tmp_path / "list.yaml").write_text("[joints]\n")
    with pytest.raises(ConfigError, match="holds list; expected groups of names"):
        make_task_on(config, Robot(other_file(tmp_path), tmp_path / "list.yaml"))


def test_a_pelvis_that_does_not_come_first_is_refused(tmp_path):
    path = other_file(tmp_path)
    tree = ElementTree.parse(path)
    world = tree.getroot().find("worldbody")
    box = ElementTree.Element("body", pos="3 0 1")
    ElementTree.SubElement(box, "joint", type="slide")
    ElementTree.SubElement(box, "geom", size="0.1")
    world.insert(0, box)
    tree.write(path)
    with pytest.raises(
        ConfigError, match=r"its first joints are \['mjJNT_SLIDE', 'mjJNT_FREE'\]; expected a free pelvis"
    ):
        make_task_on(shipped("cassie_walk"), Robot(path, mapping_file(tmp_path, RENAMED)))


def test_defaults_of_the_other_file_do_not_reach_our_actuators(tmp_path):
    path = other_file(tmp_path)
    tree = ElementTree.parse(path)
    defaults = tree.getroot().find("default")
    ElementTree.SubElement(defaults, "general", ctrllimited="true", ctrlrange="-0.1 0.1", gear="3")
    tree.write(path)
    model = make_task_on(shipped("cassie_walk"), Robot(path, mapping_file(tmp_path, RENAMED))).model
    assert not model.actuator_ctrllimited.any()
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 1)
    ours = make_task(shipped("cassie_walk")).model
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_forcelimited"):
        np.testing.assert_array_equal(getattr(model, field), getattr(ours, field), err_msg=field)
    assert [model.actuator(index).name for index in range(10)] == [ours.actuator(index).name for index in range(10)]
    assert mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, model.actuator("left-knee").trnid[0]) == "KneeL"


def test_the_command_line_plays_the_released_policy_on_it(tmp_path, capsys):
    arguments = ["--model", str(other_file(tmp_path)), "--mapping", str(mapping_file(tmp_path, RENAMED))]
    still = ["--cassie.randomize.enabled", "False", "--cassie.push.force-n", "0", "0"]
    assert evaluate_main([*arguments, *still, "--episodes", "2", "--seconds", "4", "--physics", "training"]) == 0
    assert "share_reaching_cap                   1.000" in capsys.readouterr().out
    assert evaluate_main(["--mapping", str(tmp_path / "mapping.yaml")]) == 2
    assert "--mapping: names of a --model" in capsys.readouterr().err


def test_names_that_are_not_mapped_are_ours():
    assert other_model.names_from({}, ASSET) == other_model.Names()


def test_the_environment_that_pictures_are_taken_of_and_its_copies_have_the_other_model(tmp_path):
    robot = Robot(other_file(tmp_path), mapping_file(tmp_path, RENAMED))
    env = TaskEnv(shipped("cassie_walk"), robot=robot)
    for one in (env, pickle.loads(pickle.dumps(env))):
        one.reset(seed=0)
        _, reward, terminated, _, _ = one.step(np.zeros(10, np.float32))
        assert one.task.model.nq == 36 and reward > 0 and not terminated
    live = Live(shipped("cassie_walk"), load_baseline("zero", shipped("cassie_walk"))[1], 0, robot=robot)
    assert live.model.nq == 36


def _menagerie(monkeypatch, found):
    """A package `mujoco_menagerie` whose robots are what `found` returns or raises."""
    package = types.SimpleNamespace(MenagerieError=RuntimeError, get=lambda name: types.SimpleNamespace(xml=found))
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", package)


def test_the_menagerie_gives_its_file_or_says_why_not(monkeypatch, tmp_path):
    config, robot = shipped("cassie_walk"), Robot(MENAGERIE, mapping_file(tmp_path, RENAMED))
    assert (robot.label, Robot(tmp_path / "robot.xml").label) == ("MuJoCo Menagerie", f"{tmp_path.name}/robot.xml")
    path = other_file(tmp_path)
    _menagerie(monkeypatch, lambda: path)
    assert make_task_on(config, robot).asset == path

    def closed():
        raise RuntimeError("no\nnetwork")

    _menagerie(monkeypatch, closed)
    with pytest.raises(ConfigError, match=r"agility_cassie cannot be loaded \(no network\); give a file"):
        make_task_on(config, robot)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(ConfigError, match=r'needs pip install "hasrl_jax\[menagerie\]"'):
        make_task_on(config, robot)
