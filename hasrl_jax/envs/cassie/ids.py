"""Where the numbers of the Cassie task stand in the arrays of its model; names become indices here and nowhere else."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import mujoco
import numpy as np

MOTORS = ("hip-roll", "hip-yaw", "hip-pitch", "knee", "foot")  # per leg, left leg first
PASSIVE_JOINTS = ("shin", "tarsus", "foot")  # per leg, left leg first
SIDES = ("left", "right")
# Of the motors of both legs, left leg first: a mirror changes the sign of what rolls and yaws.
MOTOR_SIGNS = tuple(-1.0 if name in ("hip-roll", "hip-yaw") else 1.0 for name in MOTORS) * 2
NO_NAMES: Mapping[str, str] = MappingProxyType({})  # everything is called as in our file


Place = np.ndarray | slice


class CassieIds(NamedTuple):
    """Where the numbers of the Cassie task stand in qpos, qvel and sensordata; a slice where they are evenly spaced."""

    motor_qpos: np.ndarray  # [10]
    motor_qvel: np.ndarray  # [10]
    passive_qpos: np.ndarray  # [6]
    encoder_qpos: np.ndarray  # [16] of the motors and the passive joints
    encoder_qvel: np.ndarray  # [16]
    hip_roll_qvel: Place  # [2]
    acceleration: Place  # [3] in sensordata
    foot_force: Place  # [2]
    foot_orientation: np.ndarray  # [2, 4]
    foot_velocity: np.ndarray  # [2, 3]
    torque: Place  # [10]
    motor_speed: Place  # [10]


def evenly_spaced(indices: np.ndarray) -> Place:
    """The same places as a slice if there is one: NumPy then copies nothing."""
    start, end, steps = int(indices[0]), int(indices[-1]), np.unique(np.diff(indices))
    return slice(start, end + 1, int(steps[0])) if len(steps) == 1 and steps[0] > 0 else indices


def cassie_ids(
    model: mujoco.MjModel, joints: Mapping[str, str] = NO_NAMES, sensors: Mapping[str, str] = NO_NAMES
) -> CassieIds:
    """Resolves every name that the task reads.

    Args:
      model: of the robot.
      joints: what `model` calls them, by their name in our file, where it differs.
      sensors: the same for sensors.
    """

    def joints_of_both(names: tuple[str, ...]) -> list[Any]:
        ours = [f"{side}-{name}" for side in SIDES for name in names]
        return [model.joint(joints.get(name, name)) for name in ours]

    def places(*names: str) -> np.ndarray:
        found = [model.sensor(sensors.get(name, name)) for name in names]
        return np.array([sensor.adr[0] + np.arange(sensor.dim[0]) for sensor in found])

    motors, passive = joints_of_both(MOTORS), joints_of_both(PASSIVE_JOINTS)
    encoders = motors + passive

    return CassieIds(
        motor_qpos=np.array([joint.qposadr[0] for joint in motors]),
        motor_qvel=np.array([joint.dofadr[0] for joint in motors]),
        passive_qpos=np.array([joint.qposadr[0] for joint in passive]),
        encoder_qpos=np.array([joint.qposadr[0] for joint in encoders]),
        encoder_qvel=np.array([joint.dofadr[0] for joint in encoders]),
        hip_roll_qvel=evenly_spaced(np.array([motors[0].dofadr[0], motors[5].dofadr[0]])),
        acceleration=evenly_spaced(places("pelvis-acceleration")[0]),
        foot_force=evenly_spaced(places("left-foot-force", "right-foot-force")[:, 0]),
        foot_orientation=places("left-foot-orientation", "right-foot-orientation"),
        foot_velocity=places("left-foot-velocity", "right-foot-velocity"),
        torque=evenly_spaced(places(*(f"{side}-{name}-torque" for side in SIDES for name in MOTORS))[:, 0]),
        motor_speed=evenly_spaced(places(*(f"{side}-{name}-speed" for side in SIDES for name in MOTORS))[:, 0]),
    )
