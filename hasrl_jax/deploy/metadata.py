"""What a file must say of its policy, so that it can be played without this package. docs/deploy.md explains each name.

All of it comes from what the task declares, its model and the configuration of the training.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

import hasrl_jax
from hasrl_jax.config import tasks
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import layout, motors
from hasrl_jax.envs.layout import Entry
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.learn.lstm import GATES
from hasrl_jax.learn.networks import LSTM_LAYERS, OBSERVATION_CLIP
from hasrl_jax.policy.loading import under_reference_physics
from hasrl_jax.policy.numpy_networks import Parameters

FORMAT_VERSION = 1
GATE_ORDER = ("input", "forget", "candidate", "output")
assert len(GATE_ORDER) == GATES


def describe(config: Config, training_sha256: str) -> dict[str, Any]:
    """The description of a policy, ready for JSON.

    Args:
      config: what it was trained with.
      training_sha256: as `training_digest` returns it.
    """
    config = tasks.find(config.task).undisturbed(config)
    task = make_task(config)
    reference = under_reference_physics(config).physics
    return {
        "format_version": FORMAT_VERSION,
        "written_by": f"hasrl_jax {hasrl_jax.__version__}",
        "training_sha256": training_sha256,
        "task": task.name,
        "policy_rate_hz": 1 / task.env_step_s,
        "physics": {"trained": dataclasses.asdict(config.physics), "reference": dataclasses.asdict(reference)},
        "observation": _table(task.observation),
        "action": _table(task.action),
        "control": _control(task),
        "actuators": _actuators(task.model),
        "commands": [
            {
                "name": command.name,
                "unit": command.unit,
                "default": command.default,
                "drawn_range": list(command.drawn),
                "measured_by": command.measure,
            }
            for command in task.commands
        ],
        "constants": task.player_constants,
        "network": {
            "memory": config.network.memory,
            "layers": LSTM_LAYERS,
            "hidden_size": config.network.hidden_size,
            "symmetric": config.network.symmetric,
            "normalized": config.network.normalize_observations,
            "observation_clip": OBSERVATION_CLIP,
            "gate_order": list(GATE_ORDER),
            "carry_shape": list(config.network.carry_shape),
        },
    }


def training_digest(config: Config, parameters: Parameters) -> str:
    """SHA-256, in hexadecimal, over the resolved configuration and every parameter: which training this came from.

    Where the run's directory lay does not enter.

    Args:
      config: what it was trained with.
      parameters: as `learn.ppo.export_parameters` returns them.
    """
    digest = hashlib.sha256(json.dumps(to_dict(config) | {"run_dir": ""}, sort_keys=True).encode())
    for name in sorted(parameters):
        digest.update(name.encode() + parameters[name].tobytes())
    return digest.hexdigest()


def _table(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """One row per quantity: its name, unit, place and the names of its numbers."""
    places = layout.places(entries)
    return [
        {
            "name": entry.name,
            "unit": entry.unit,
            "start": places[entry.name].start,
            "size": entry.size,
            "parts": list(entry.parts),
            "note": entry.note,
        }
        for entry in entries
    ]


def _control(task: Task) -> dict[str, Any] | None:
    """How an action becomes the control of the actuators, offset + scale * clip(action); None where it is not so."""
    states = [task.reset(np.full(task.reset_uniforms, uniform), np).state for uniform in (0.0, 0.7)]

    def control(action: np.ndarray, state: Any = states[0]) -> np.ndarray:
        return np.asarray(task.control(state, action, np))

    size = task.action_size
    offset = control(np.zeros(size))
    if offset.shape != (size,) or not np.array_equal(offset, control(np.zeros(size), states[1])):
        return None  # or it changes within an episode, as with a reference
    scale = np.diag([control(unit) for unit in np.eye(size)] - offset)
    probe = np.linspace(-2.0, 2.0, size) if size > 1 else np.full(size, 2.0)
    if not np.allclose(control(probe), offset + scale * np.clip(probe, -1, 1), atol=1e-12):
        return None
    return {"clip": [-1.0, 1.0], "scale": scale.tolist(), "offset": offset.tolist()}


def _actuators(model: mujoco.MjModel) -> list[dict[str, Any]]:
    """In the order of the control: force = gain * control + bias . (1, gear * position, gear * velocity), limited.

    Limited to `force_range`, and where there is a torque-speed curve, by `envs.motors`, also by that.
    """
    model, curve = motors.without_curve(model)

    def limits(limited: bool, values: np.ndarray) -> list[float] | None:
        return values.tolist() if limited else None

    return [
        {
            "name": model.actuator(index).name,
            "joint": model.joint(model.actuator_trnid[index, 0]).name,
            "gear": float(model.actuator_gear[index, 0]),
            "gain": float(model.actuator_gainprm[index, 0]),
            "bias": model.actuator_biasprm[index, :3].tolist(),
            "force_range": limits(bool(model.actuator_forcelimited[index]), model.actuator_forcerange[index]),
            "control_range": limits(bool(model.actuator_ctrllimited[index]), model.actuator_ctrlrange[index]),
            "no_load_speed": None if curve is None else float(curve.no_load_speed[index]),
            "stall_torque": None if curve is None else float(curve.stall_torque[index]),
        }
        for index in range(model.nu)
    ]
