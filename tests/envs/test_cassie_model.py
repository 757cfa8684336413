"""Holds `envs/cassie/cassie.xml` to the published parameters of Cassie, and to how a legged robot must behave."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from hasrl_jax.envs.cassie.task import ASSET

PARAMETERS: dict[str, Any] = json.loads((Path(__file__).parents[1] / "data" / "cassie_parameters.json").read_text())
TOLERANCE = 1e-6
PHYSICS_DT_S = 0.0005
NEUTRAL_TARGETS = np.array([actuator["paper_neutral_target_rad"] for actuator in PARAMETERS["actuators"]])


def by_name(record: dict[str, Any]) -> str:
    """The name that a parametrised test shows for one record."""
    return record["name"]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The compiled model exactly as the file states it, before any physics option is applied."""
    return mujoco.MjModel.from_xml_path(str(ASSET))


def at_stand(model: mujoco.MjModel) -> mujoco.MjData:
    """A fresh state at the `stand` keyframe."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    return data


def assert_close(actual: Any, expected: Any) -> None:
    """Equal within 1e-6, absolute: every compared quantity is in SI units and of order one or below."""
    np.testing.assert_allclose(np.asarray(actual, float), np.asarray(expected, float), rtol=0, atol=TOLERANCE)


def assert_same_rotation(actual: Any, expected: Any) -> None:
    """Equal as rotations: q and -q are the same one."""
    assert_close(actual * np.sign(np.dot(actual, expected)), expected)


def is_collision(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] can touch anything."""
    return (model.geom_contype | model.geom_conaffinity) != 0


def closure_errors_m(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Distance [neq] in metres between the two anchors of each loop closure."""
    return np.array(
        [
            np.linalg.norm(
                data.xpos[first]
                + data.xmat[first].reshape(3, 3) @ anchors[:3]
                - data.xpos[second]
                - data.xmat[second].reshape(3, 3) @ anchors[3:6]
            )
            for first, second, anchors in zip(model.eq_obj1id, model.eq_obj2id, model.eq_data, strict=True)
        ]
    )


def test_sizes(model: mujoco.MjModel) -> None:
    assert (model.nq, model.nv, model.nu, model.nbody) == (35, 32, 10, 26)
    sizes = PARAMETERS["sizes"]
    assert (model.nq, model.nv, model.nu, model.nbody) == (sizes["nq"], sizes["nv"], sizes["nu"], sizes["nbody"])
    assert_close(model.body_mass.sum(), sizes["total_mass_kg"])
    assert model.opt.timestep == PHYSICS_DT_S


@pytest.mark.parametrize("expected", PARAMETERS["bodies"], ids=by_name)
def test_body(model: mujoco.MjModel, expected: dict[str, Any]) -> None:
    body = model.body(expected["name"])
    assert model.body(body.parentid[0]).name == expected["parent"]
    assert_close(body.pos, expected["pos_m"])
    assert_same_rotation(body.quat, expected["quat"])
    assert_close(body.mass[0], expected["mass_kg"])
    assert_close(body.inertia, expected["inertia_kgm2"])
    assert_close(body.ipos, expected["ipos_m"])
    assert_same_rotation(body.iquat, expected["iquat"])


def test_bodies_are_all_listed(model: mujoco.MjModel) -> None:
    assert [model.body(index).name for index in range(1, model.nbody)] == [by_name(b) for b in PARAMETERS["bodies"]]


@pytest.mark.parametrize("expected", PARAMETERS["joints"], ids=by_name)
def test_joint(model: mujoco.MjModel, expected: dict[str, Any]) -> None:
    joint = model.joint(expected["name"])
    assert joint.type[0] == getattr(mujoco.mjtJoint, f"mjJNT_{expected['type'].upper()}")
    assert model.body(joint.bodyid[0]).name == expected["body"]
    assert (joint.qposadr[0], joint.dofadr[0]) == (expected["qpos_adr"], expected["dof_adr"])
    assert_close(joint.pos, expected["pos_m"])
    assert_close(joint.axis, expected["axis"])
    assert bool(joint.limited[0]) == expected["limited"]
    assert_close(joint.range, expected["range_rad"])
    # MuJoCo 3.17 keeps a polynomial of coefficients; the linear one leads and the rest must be absent.
    for values, key in ((joint.stiffness, "stiffness"), (joint.damping, "damping"), (joint.armature, "armature")):
        assert_close(np.unique(np.ravel(values)), [expected[key]])
    if expected["type"] == "ball":  # a ball joint has four reference numbers, not one
        assert_close(model.qpos0[joint.qposadr[0] :][:4], [1, 0, 0, 0])
        return
    assert_close(model.qpos0[joint.qposadr[0]], expected["ref_rad_or_m"])
    assert_close(model.qpos_spring[joint.qposadr[0]], expected["springref"])


def test_joints_are_all_listed(model: mujoco.MjModel) -> None:
    assert [model.joint(index).name for index in range(model.njnt)] == [by_name(j) for j in PARAMETERS["joints"]]


def test_closures(model: mujoco.MjModel) -> None:
    expected_closures = PARAMETERS["equality_connect"]
    assert model.neq == len(expected_closures)
    for index, expected in enumerate(expected_closures):
        assert model.eq_type[index] == mujoco.mjtEq.mjEQ_CONNECT
        assert model.eq_active0[index]
        assert model.body(model.eq_obj1id[index]).name == expected["body1"]
        assert model.body(model.eq_obj2id[index]).name == expected["body2"]
        assert_close(model.eq_data[index, :6], expected["anchor1_m"] + expected["anchor2_m"])
        assert_close(model.eq_solref[index], expected["solref"])
        assert_close(model.eq_solimp[index], expected["solimp"])


def test_collision_geoms(model: mujoco.MjModel) -> None:
    ids = np.flatnonzero(is_collision(model))
    assert len(ids) == len(PARAMETERS["collision_geoms"])
    for index, expected in zip(ids, PARAMETERS["collision_geoms"], strict=True):
        geom = model.geom(index)
        assert model.body(geom.bodyid[0]).name == expected["body"]
        assert geom.type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{expected['type'].upper()}")
        assert_close(geom.size, expected["size_m"])
        assert_close(geom.pos, expected["pos_m"])
        assert_same_rotation(geom.quat, expected["quat"])
        for key in ("contype", "conaffinity", "condim", "priority"):
            assert getattr(geom, key)[0] == expected[key], (expected["body"], key)
        for key in ("friction", "solref", "solimp"):
            assert_close(getattr(geom, key), expected[key])


def test_what_is_only_seen_never_touches(model: mujoco.MjModel) -> None:
    seen_only = ~is_collision(model)
    assert 0 < seen_only.sum() <= 45  # each one costs kinematics at every physics step
    assert set(model.geom_group[seen_only]) == {2}
    assert set(model.geom_group[is_collision(model)]) == {0, 3}  # the floor, and the hidden collision shapes
    assert set(model.site_group) == {4}
    assert model.nmesh == 0
    # Contacts come from geoms only, so a site cannot make one; nor may an explicit pair bypass the masks.
    assert model.npair == 0

    data = at_stand(model)
    touched: set[int] = set()
    for _ in range(3000):
        mujoco.mj_step(model, data)
        touched.update(data.contact.geom.ravel().tolist())
    assert touched
    assert not touched & set(np.flatnonzero(seen_only).tolist())


@pytest.mark.parametrize("expected", PARAMETERS["actuators"], ids=by_name)
def test_actuator(model: mujoco.MjModel, expected: dict[str, Any]) -> None:
    actuator = model.actuator(expected["name"])
    p_gain, d_gain = expected["paper_p_gain_Nm_per_rad"], expected["paper_d_gain_Nms_per_rad"]
    assert model.joint(actuator.trnid[0]).name == expected["joint"]
    assert actuator.trntype[0] == mujoco.mjtTrn.mjTRN_JOINT
    assert actuator.gaintype[0] == mujoco.mjtGain.mjGAIN_FIXED
    assert actuator.biastype[0] == mujoco.mjtBias.mjBIAS_AFFINE
    assert actuator.dyntype[0] == mujoco.mjtDyn.mjDYN_NONE
    assert_close(actuator.gear, [1, 0, 0, 0, 0, 0])
    assert_close(actuator.gainprm[:3], [p_gain, 0, 0])
    assert_close(actuator.biasprm[:3], [0, -p_gain, -d_gain])
    assert actuator.forcelimited[0]
    assert_close(actuator.forcerange, expected["joint_torque_limit_Nm"])


def test_actuators_are_a_clipped_pd_law(model: mujoco.MjModel) -> None:
    """torque = clip(P (target - q) - D q', limits), with P, D and limits from the parameters, on random states."""
    actuators = PARAMETERS["actuators"]
    p_gain = np.array([actuator["paper_p_gain_Nm_per_rad"] for actuator in actuators])
    d_gain = np.array([actuator["paper_d_gain_Nms_per_rad"] for actuator in actuators])
    low, high = np.array([actuator["joint_torque_limit_Nm"] for actuator in actuators]).T
    joints = [model.joint(actuator["joint"]) for actuator in actuators]
    qpos_ids, dof_ids = np.array([(joint.qposadr[0], joint.dofadr[0]) for joint in joints]).T
    rng = np.random.default_rng(0)
    clipped = []
    for _ in range(20):
        data = at_stand(model)
        data.qpos[qpos_ids] += rng.normal(scale=0.5, size=10)
        data.qvel[:] = rng.normal(scale=5.0, size=model.nv)
        data.ctrl[:] = NEUTRAL_TARGETS + rng.normal(size=10)
        mujoco.mj_forward(model, data)
        free = p_gain * (data.ctrl - data.qpos[qpos_ids]) - d_gain * data.qvel[dof_ids]
        np.testing.assert_allclose(data.actuator_force, np.clip(free, low, high), rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qfrc_actuator[dof_ids], data.actuator_force, rtol=0, atol=1e-9)
        clipped.append((free < low) | (free > high))
    assert 0 < np.mean(clipped) < 1  # both branches of the clip were compared


def test_stand_keyframe_is_the_initial_state(model: mujoco.MjModel) -> None:
    key = model.key("stand")
    expected = np.array(PARAMETERS["initial_qpos"], float)
    mujoco.mj_normalizeQuat(model, expected)  # the published quaternions are rounded; compiling makes them unit length
    assert_close(key.qpos, expected)
    assert_close(key.qvel, np.zeros(model.nv))


@pytest.mark.parametrize(
    ("targets", "start_height_m", "limit_m"),
    [(NEUTRAL_TARGETS, 7.0, 0.0002), (NEUTRAL_TARGETS, 1.01, 0.004), (np.zeros(10), 1.01, 0.008)],
    ids=["unloaded", "neutral", "zero"],
)
def test_one_second_fall_stays_finite_and_closed(
    model: mujoco.MjModel, targets: np.ndarray, start_height_m: float, limit_m: float
) -> None:
    """The loops stay as closed as their published solver parameters can hold them.

    The published initial state leaves the plantar loops open by about 7 mm, so the first 50 ms are the time that the
    constraints need to pull them shut. In free fall they then close to 0.1 mm. Under load they are springs: with
    solref 0.005 and solimp 0.9 to 0.95 the achilles rod gives 3.5 mm as the robot sinks, and 6.7 mm as targets of zero
    drive the legs straight. More solver iterations change neither figure; only stiffer parameters would.
    """
    data = at_stand(model)
    data.qpos[2] = start_height_m
    data.ctrl[:] = targets
    errors_m = []
    for _ in range(round(1.0 / PHYSICS_DT_S)):
        mujoco.mj_step(model, data)
        errors_m.append(closure_errors_m(model, data))
    assert np.isfinite(data.qpos).all()
    assert np.isfinite(data.qvel).all()
    assert not any(warning.number for warning in data.warning)
    assert np.max(errors_m[100:]) < limit_m


# Reflection in the plane y = 0. The legs swap places; of their coordinates only hip roll, hip yaw and two components
# of the achilles ball change sign, because below the hips every other hinge turns about the lateral axis.
PELVIS_QPOS_SIGNS = np.array([1, -1, 1, 1, -1, 1, -1])
PELVIS_QVEL_SIGNS = np.array([1, -1, 1, -1, 1, -1])
LEG_QPOS_SIGNS = np.array([-1, -1, 1, 1, -1, -1, 1] + [1] * 7)
LEG_QVEL_SIGNS = np.array([-1, -1, 1, -1, -1, 1] + [1] * 7)
LEG_TARGET_SIGNS = np.array([-1, -1, 1, 1, 1])


def mirrored(values: np.ndarray, pelvis_signs: np.ndarray, leg_signs: np.ndarray) -> np.ndarray:
    """The mirror image of [pelvis, left leg, right leg]."""
    pelvis, left, right = np.split(values, [len(pelvis_signs), len(pelvis_signs) + len(leg_signs)])
    return np.concatenate([pelvis_signs * pelvis, leg_signs * right, leg_signs * left])


def fall(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, int]:
    """Half a second from one state: every qpos [1000, 35], and the largest number of contacts."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, targets
    states, contacts = [], 0
    for _ in range(1000):
        mujoco.mj_step(model, data)
        states.append(data.qpos.copy())
        contacts = max(contacts, data.ncon)
    return np.array(states), contacts


def test_a_mirrored_state_falls_as_the_mirror_image(model: mujoco.MjModel) -> None:
    """Tolerance 2e-3 (metres, radians): the legs mirror exactly, the pelvis does not.

    Its centre of mass lies 0.35 mm left of the middle, which the fall amplifies to about 1e-3 in half a second. A wrong
    joint axis or a closure 1 mm off exceeds the tolerance; a slip in one small inertia does not, and is left to
    `test_body`.
    """
    rng = np.random.default_rng(0)
    qpos = model.key("stand").qpos.copy()
    qpos[2] = 1.05
    qpos[3:7] = np.array([0.99, 0.08, 0.05, 0.03]) / np.linalg.norm([0.99, 0.08, 0.05, 0.03])
    qvel = np.zeros(model.nv)
    qvel[:6] = rng.normal(scale=0.3, size=6)
    targets = NEUTRAL_TARGETS + rng.normal(scale=0.1, size=10)
    original, contacts = fall(model, qpos, qvel, targets)
    image, _ = fall(
        model,
        mirrored(qpos, PELVIS_QPOS_SIGNS, LEG_QPOS_SIGNS),
        mirrored(qvel, PELVIS_QVEL_SIGNS, LEG_QVEL_SIGNS),
        mirrored(targets, np.array([]), LEG_TARGET_SIGNS),
    )
    expected = np.array([mirrored(state, PELVIS_QPOS_SIGNS, LEG_QPOS_SIGNS) for state in original])
    assert contacts > 0  # otherwise the feet were never compared
    assert np.ptp(original[:, 2]) > 0.1
    np.testing.assert_allclose(image, expected, rtol=0, atol=2e-3)
