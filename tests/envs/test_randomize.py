"""Dynamics randomisation: what changes, by how much, and from which draws."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hasrl_jax.config.schema import PhysicsConfig
from hasrl_jax.envs.cassie import randomize
from hasrl_jax.envs.cassie.settings import RandomizeConfig
from hasrl_jax.envs.cassie.task import ASSET
from hasrl_jax.envs.model import load_model

CONFIG = RandomizeConfig()
MODEL = load_model(ASSET, PhysicsConfig())
NOMINAL = randomize.nominal(MODEL)
N = 400
NONE = np.zeros((N, 0))  # no draws beyond the paper


@pytest.fixture(scope="module")
def uniforms() -> np.ndarray:
    return np.random.default_rng(0).random((N, randomize.num_uniforms(NOMINAL)))


@pytest.fixture(scope="module")
def fields(uniforms: np.ndarray) -> dict[str, np.ndarray]:
    return randomize.model_fields(uniforms, NONE, NOMINAL, CONFIG, np)


def _fills(values: np.ndarray, bounds: tuple[float, float]) -> bool:
    """All values within the bounds, and the bounds nearly reached."""
    low, high = bounds
    reach = 0.05 * (high - low)
    inside = values.min() >= low and values.max() < high
    return bool(inside and values.min() < low + reach and values.max() > high - reach)


def test_ranges(fields: dict[str, np.ndarray]) -> None:
    mass_scale = fields["body_mass"][:, 1:] / NOMINAL.body_mass[1:]
    assert all(_fills(mass_scale[:, body], CONFIG.mass_scale) for body in range(MODEL.nbody - 1))
    assert _fills(fields["geom_friction"][..., 0], CONFIG.sliding_friction)
    assert _fills(fields["geom_friction"][..., 1], CONFIG.torsional_friction)
    assert _fills(fields["geom_friction"][..., 2], CONFIG.rolling_friction)
    assert _fills(fields["timestep"] / MODEL.opt.timestep, CONFIG.physics_rate_scale)
    assert (fields["geom_friction"] == fields["geom_friction"][:, :1]).all()  # one draw for all geoms


def test_only_the_named_joints_change_their_damping(fields: dict[str, np.ndarray]) -> None:
    draws = set()
    for joint in range(MODEL.njnt):
        name = MODEL.joint(joint).name
        side, _, kind = name.partition("-")
        start = MODEL.jnt_dofadr[joint]
        count = 3 if MODEL.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL else 1
        damping = fields["dof_damping"][:, start : start + count]
        nominal = NOMINAL.dof_damping[start : start + count]
        if side in ("left", "right") and kind in randomize.DAMPED_JOINTS:
            scale = damping / nominal
            assert _fills(scale[:, 0], CONFIG.damping_scale), name
            np.testing.assert_allclose(scale, scale[:, :1].repeat(count, 1), err_msg=name)  # one draw per joint
            draws.add(tuple(scale[:3, 0]))
        else:
            assert (damping == nominal).all(), name
    assert len(draws) == 2 * len(randomize.DAMPED_JOINTS)  # every joint has a draw of its own


def test_inertia_and_subtree_follow_the_mass(fields: dict[str, np.ndarray]) -> None:
    scale = fields["body_mass"][:, 1:] / NOMINAL.body_mass[1:]
    np.testing.assert_allclose(fields["body_inertia"][:, 1:], NOMINAL.body_inertia[1:] * scale[..., None])
    np.testing.assert_allclose(fields["body_subtreemass"][:, 0], fields["body_mass"].sum(axis=1))
    data = mujoco.MjData(MODEL)
    for row in range(3):  # MuJoCo's own sum
        model = load_model(ASSET, PhysicsConfig())
        model.body_mass[:] = fields["body_mass"][row]
        mujoco.mj_setConst(model, data)
        np.testing.assert_allclose(fields["body_subtreemass"][row], model.body_subtreemass)


def test_same_uniforms_same_fields(uniforms: np.ndarray, fields: dict[str, np.ndarray]) -> None:
    again = randomize.model_fields(uniforms[7:8], NONE[7:8], NOMINAL, CONFIG, np)
    jax_fields = randomize.model_fields(jnp.asarray(uniforms[7:8]), NONE[7:8], NOMINAL, CONFIG, jnp)
    assert set(again) == set(fields) == set(jax_fields)
    for name, values in again.items():
        np.testing.assert_allclose(values[0], fields[name][7], rtol=1e-12, err_msg=name)
        np.testing.assert_allclose(values, jax_fields[name], rtol=1e-5, err_msg=name)


def test_a_share_of_the_robots_is_drawn(uniforms: np.ndarray) -> None:
    config = RandomizeConfig(share=0.3)
    fields, drawn = randomize.model_fields(uniforms, NONE, NOMINAL, config, np), randomize.is_drawn(uniforms, config)
    assert 0.2 < drawn.mean() < 0.4
    everywhere = randomize.model_fields(uniforms, NONE, NOMINAL, CONFIG, np)
    for name, values in fields.items():
        own = MODEL.opt.timestep if name == "timestep" else getattr(MODEL, name)
        np.testing.assert_array_equal(values[drawn], everywhere[name][drawn])
        np.testing.assert_allclose(values[~drawn], np.broadcast_to(own, values[~drawn].shape), rtol=1e-12)


def test_what_mujoco_derives_from_masses_follows_them(fields: dict[str, np.ndarray]) -> None:
    """Against MuJoCo's own `mj_setConst`, which needs a model and no draws."""
    for row in range(3):
        model = load_model(ASSET, PhysicsConfig())
        model.body_mass[:], model.body_inertia[:] = fields["body_mass"][row], fields["body_inertia"][row]
        stale = model.body_invweight0.copy()
        mujoco.mj_setConst(model, mujoco.MjData(model))
        np.testing.assert_allclose(fields["body_invweight0"][row], model.body_invweight0, rtol=1e-9)
        np.testing.assert_allclose(fields["dof_invweight0"][row], model.dof_invweight0, rtol=1e-9)
        assert abs(stale[1:] / model.body_invweight0[1:] - 1).max() > 0.1


BEYOND = RandomizeConfig(
    pd_gain_scale=(0.8, 1.2),
    torque_scale=(0.7, 1.0),
    spring_scale=(0.9, 1.1),
    payload_kg=(-2.0, 5.0),
    center_of_mass_m=0.03,
)


def test_draws_beyond_the_paper(uniforms: np.ndarray, fields: dict[str, np.ndarray]) -> None:
    more = np.random.default_rng(1).random((N, randomize.num_uniforms_beyond(BEYOND)))
    drawn = randomize.model_fields(uniforms, more, NOMINAL, BEYOND, np)
    gain = drawn["actuator_gainprm"][..., 0] / MODEL.actuator_gainprm[:, 0]
    assert all(_fills(gain[:, motor], BEYOND.pd_gain_scale) for motor in range(MODEL.nu))
    np.testing.assert_allclose(drawn["actuator_biasprm"][..., 1], -drawn["actuator_gainprm"][..., 0])
    np.testing.assert_allclose(drawn["actuator_biasprm"][..., 2], MODEL.actuator_biasprm[:, 2] * gain)
    torque = drawn["actuator_forcerange"] / MODEL.actuator_forcerange
    assert all(_fills(torque[:, motor, 1], BEYOND.torque_scale) for motor in range(MODEL.nu))
    np.testing.assert_array_equal(torque[..., 0], torque[..., 1])
    springs = [MODEL.joint(f"{side}-{name}").id for side in ("left", "right") for name in ("shin", "heel-spring")]
    stiffness = drawn["jnt_stiffness"][:, springs] / MODEL.jnt_stiffness[springs]
    assert all(_fills(stiffness[:, spring], BEYOND.spring_scale) for spring in range(4))
    assert not np.delete(drawn["jnt_stiffness"], springs, axis=1).any()
    pelvis = MODEL.body("cassie-pelvis").id
    carried = drawn["body_mass"] - fields["body_mass"]
    assert _fills(carried[:, pelvis], BEYOND.payload_kg)
    assert not np.delete(carried, pelvis, axis=1).any()
    shift = drawn["body_ipos"] - MODEL.body_ipos
    assert all(_fills(shift[:, pelvis, axis], (-0.03, 0.03)) for axis in range(3))
    assert not np.delete(shift, pelvis, axis=1).any()
    for name in ("dof_damping", "geom_friction", "timestep"):  # the paper's draws stay what they were
        np.testing.assert_array_equal(drawn[name], fields[name])


def test_off_switch(uniforms: np.ndarray) -> None:
    assert randomize.model_fields(uniforms, NONE, NOMINAL, RandomizeConfig(enabled=False), np) == {}
    assert randomize.num_uniforms_beyond(RandomizeConfig()) == 0
    assert randomize.num_uniforms_beyond(RandomizeConfig(enabled=False, pd_gain_scale=(0.8, 1.2))) == 0
