"""Where the numbers of the Cassie task stand in the arrays of its model; names become indices here and nowhere else."""

from typing import NamedTuple

import mujoco
import numpy as np

MOTORS = ("hip-roll", "hip-yaw", "hip-pitch", "knee", "foot")  # per leg, left leg first
PASSIVE_JOINTS = ("shin", "tarsus", "foot")  # per leg, left leg first
SIDES = ("left", "right")


Place = np.ndarray | slice


class CassieIds(NamedTuple):
    """Where the numbers of the Cassie task stand in qpos, qvel and sensordata; a slice where they are evenly spaced."""

    motor_qpos: np.ndarray  # [10]
    motor_qvel: np.ndarray  # [10]
    passive_qpos: np.ndarray  # [6]
    passive_qvel: np.ndarray  # [6]
    hip_roll_qvel: np.ndarray  # [2]
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


def cassie_ids(model: mujoco.MjModel) -> CassieIds:
    """Resolves every name that the task reads."""
    motors = [model.joint(f"{side}-{name}") for side in SIDES for name in MOTORS]
    passive = [model.joint(f"{side}-{name}") for side in SIDES for name in PASSIVE_JOINTS]

    def sensors(*names: str) -> np.ndarray:
        return np.array([model.sensor(name).adr[0] + np.arange(model.sensor(name).dim[0]) for name in names])

    return CassieIds(
        motor_qpos=np.array([joint.qposadr[0] for joint in motors]),
        motor_qvel=np.array([joint.dofadr[0] for joint in motors]),
        passive_qpos=np.array([joint.qposadr[0] for joint in passive]),
        passive_qvel=np.array([joint.dofadr[0] for joint in passive]),
        hip_roll_qvel=np.array([motors[0].dofadr[0], motors[5].dofadr[0]]),
        acceleration=evenly_spaced(sensors("pelvis-acceleration")[0]),
        foot_force=evenly_spaced(sensors("left-foot-force", "right-foot-force")[:, 0]),
        foot_orientation=sensors("left-foot-orientation", "right-foot-orientation"),
        foot_velocity=sensors("left-foot-velocity", "right-foot-velocity"),
        torque=evenly_spaced(sensors(*(f"{side}-{name}-torque" for side in SIDES for name in MOTORS))[:, 0]),
        motor_speed=evenly_spaced(sensors(*(f"{side}-{name}-speed" for side in SIDES for name in MOTORS))[:, 0]),
    )
