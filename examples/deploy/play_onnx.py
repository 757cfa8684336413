"""Plays an ONNX policy of Cassie on MuJoCo, without the package that trained it: numpy, mujoco and onnxruntime.

hasrl export --policy released --format onnx --out policy.onnx --model cassie.xml
python play_onnx.py policy.onnx cassie.xml --seconds 10 --command forward=1.0
"""

import argparse
import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime


def turned(vector, angle):
    """A vector turned about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1], *vector[2:]])


def observe(data, about, memory, moved):
    """What the policy sees, by name; `moved` is whether any physics step was taken yet."""
    quat, velocity, upward = data.qpos[3:7].copy(), data.qvel[0:3].copy(), np.zeros(9)
    mujoco.mju_quat2Mat(upward, quat)
    proper = data.sensor("pelvis-acceleration").data - about["constants"]["gravity_m_s2"] * upward[6:9]
    if about["constants"]["command_frame"] == "heading":
        half = -memory["heading"] / 2
        mujoco.mju_mulQuat(quat, np.array([np.cos(half), 0, 0, np.sin(half)]), quat.copy())
        quat, velocity = quat if quat[0] >= 0 else -quat, turned(velocity, -memory["heading"])
    angle = 2 * np.pi * memory["phase"]
    parts = {entry["name"]: entry["parts"] for entry in about["observation"]}
    return {
        "pelvis_height": data.qpos[2:3],
        "pelvis_orientation": quat,
        "motor_positions": [data.joint(name).qpos[0] for name in parts["motor_positions"]],
        "pelvis_velocity": velocity,
        "pelvis_angular_velocity": data.qvel[3:6],
        "motor_velocities": [data.joint(name).qvel[0] for name in parts["motor_velocities"]],
        "pelvis_acceleration": proper if moved else np.zeros(3),
        "passive_positions": [data.joint(name).qpos[0] for name in parts["passive_positions"]],
        "passive_velocities": [data.joint(name).qvel[0] for name in parts["passive_velocities"]],
        "clock": [0, 0] if memory["standing"] else [np.sin(angle), np.cos(angle)],
        **{f"{name}_command": [value] for name, value in memory["command"].items()},
    }


def advance(data, about, memory):
    """Moves the clock and the heading to keep on by the policy step that has just been simulated."""
    clock, step_s = about["constants"]["clock"], 1 / about["policy_rate_hz"]
    told = memory["command"]
    if about["constants"]["command_frame"] == "heading":
        w, x, y, z = data.qpos[3:7]
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        ahead, limit = memory["heading"] + told["yaw_rate"] * step_s - heading, about["constants"]["heading"]
        ahead = np.arctan2(np.sin(ahead), np.cos(ahead))
        memory["heading"] = heading + np.clip(ahead, -limit["max_heading_error_rad"], limit["max_heading_error_rad"])
    if not memory["standing"]:
        faster = max(abs(told["forward"]) - clock["quicken_above_m_s"], 0.0)
        memory["phase"] = (memory["phase"] + step_s / (clock["cycle_s"] + clock["cycle_per_speed_s"] * faster)) % 1.0
    memory["standing"] = stands(data, about, told)


def stands(data, about, told):
    """Whether the clock rests: a policy of the heading frame that is told to stand and is slow."""
    still = not any(told.get(name) for name in ("forward", "lateral", "yaw_rate"))
    return still and np.hypot(*data.qvel[0:2]) < about["constants"]["clock"].get("stand_below_m_s", 0.0)


def play(policy, model_file, seconds, command):
    """Yields (MuJoCo's data, observation, action, seconds of the inference) after each policy step."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(policy, options, providers=["CPUExecutionProvider"])
    about = {name: json.loads(text) for name, text in session.get_modelmeta().custom_metadata_map.items()}
    model = mujoco.MjModel.from_xml_path(str(model_file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    told = {entry["name"]: entry["default"] for entry in about["commands"]}
    if command.keys() - told.keys():
        sys.exit(f"error: --command: got {', '.join(command)}; expected {', '.join(told)}")
    told |= command
    memory = {"phase": 0.0, "heading": 0.0, "command": told, "standing": stands(data, about, told)}
    carry = np.zeros((1, *about["network"]["carry_shape"]), np.float32)
    if about["control"] is None:
        sys.exit(
            "error: policy: its actions are added to a reference, which this loop does not have; see docs/deploy.md"
        )
    scale, offset = np.array(about["control"]["scale"]), np.array(about["control"]["offset"])
    for step in range(round(seconds * about["policy_rate_hz"])):
        seen = observe(data, about, memory, moved=step > 0)
        observation = np.concatenate([seen[entry["name"]] for entry in about["observation"]])
        started = time.perf_counter()
        inputs = {"observation": observation[None].astype(np.float32), "carry": carry}
        action, carry = session.run(["action", "next_carry"], inputs)
        inference_s = time.perf_counter() - started
        data.ctrl[:] = offset + scale * np.clip(action[0], *about["control"]["clip"])
        for _ in range(round(1 / about["policy_rate_hz"] / model.opt.timestep)):
            mujoco.mj_step(model, data)
        advance(data, about, memory)
        yield data, observation, action[0], inference_s
        if data.qpos[2] < about["constants"]["fall"]["min_height_m"]:
            return


def setting(text):
    """NAME=VALUE of the command line."""
    name, _, value = text.partition("=")
    return name, float(value)


def main():
    """The command line; returns 0 where the robot stayed up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="an .onnx file of `hasrl export`")
    parser.add_argument("model", type=Path, help="the .xml file of `hasrl export --model`")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--command", nargs="*", type=setting, default=[("forward", 1.0)], metavar="NAME=VALUE")
    given = parser.parse_args()
    for file in (given.policy, given.model):
        if not Path(file).is_file():
            sys.exit(f"error: got {file}; there is no such file")
    played = list(play(given.policy, given.model, given.seconds, dict(given.command)))
    if not played:
        sys.exit(f"error: --seconds: got {given.seconds:g}; expected one step of the policy or more")
    data, inferences_s = played[-1][0], [inference_s for _, _, _, inference_s in played]
    x, y, height = data.qpos[0:3]
    print(f"{data.time:.2f} s: x {x:.2f} m, y {y:.2f} m, pelvis at {height:.2f} m")
    print(f"inference: median {1e3 * np.median(inferences_s):.3f} ms, largest {1e3 * max(inferences_s):.3f} ms a step")
    return 0 if data.time > given.seconds - 0.02 else 1


if __name__ == "__main__":
    sys.exit(main())
