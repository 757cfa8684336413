"""Another MJCF file of the same robot, given what the task needs of a model: PD actuators, sensors, the initial pose.

Bodies, inertias, joints, springs, closures, contacts and ground stay as that file has them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from hasrl_jax.envs.cassie.ids import MOTORS, PASSIVE_JOINTS, SIDES
from hasrl_jax.envs.cassie.randomize import DAMPED_JOINTS, PELVIS, SPRINGS
from hasrl_jax.errors import ConfigError

_ROOT_NUMBERS = 7  # position and orientation of the pelvis, which the task expects first
_OBJECT_GROUPS = {
    mujoco.mjtObj.mjOBJ_SITE: "sites",
    mujoco.mjtObj.mjOBJ_XBODY: "bodies",
    mujoco.mjtObj.mjOBJ_BODY: "bodies",
}


class Names(NamedTuple):
    """What things are called in the other file, by their name in ours; those that are not listed have our name."""

    joints: Mapping[str, str] = {}
    bodies: Mapping[str, str] = {}
    sites: Mapping[str, str] = {}
    sensors: Mapping[str, str] = {}  # sensors to take as they are; for all others ours are put in


def names_from(mapping: Mapping[str, Any], ours: Path) -> Names:
    """Names from plain data, {group: {our name: their name}}.

    Args:
      mapping: groups are the fields of `Names`.
      ours: the MJCF file whose names are mapped.

    Raises:
      ConfigError: an unknown group, or a name that is not in `ours`.
    """
    spec = mujoco.MjSpec.from_file(str(ours))
    known = {group: {element.name for element in getattr(spec, group)} for group in Names._fields}
    for group, pairs in mapping.items():
        if group not in known:
            raise ConfigError(f"--mapping: got the group {group!r}; expected {', '.join(known)}")
        if not isinstance(pairs, Mapping):
            raise ConfigError(f"--mapping: {group}: got {pairs!r}; expected our name: their name, for each")
        for our_name, their_name in pairs.items():
            if our_name not in known[group] or not isinstance(their_name, str):
                raise ConfigError(
                    f"--mapping: {group}: got {our_name!r}: {their_name!r}; expected one of our names "
                    f"({', '.join(sorted(filter(None, known[group])))}) and a text"
                )
    return Names(**mapping)


def adapt(names: Names, file: Path, ours: Path, spec: mujoco.MjSpec) -> None:
    """Puts our actuators, sensors and initial pose into the description of another file.

    Args:
      names: what things are called there.
      file: the other file, for messages.
      ours: our MJCF file.
      spec: the description of `file`; changed in place.

    Raises:
      ConfigError: something is not there, the pelvis is not first, or there is no ground.
    """
    reference = mujoco.MjSpec.from_file(str(ours))
    _require(names, file, spec)
    for kept, elements in ((names.sensors.values(), spec.sensors), ((), spec.actuators), ((), spec.keys)):
        for element in list(elements):
            if element.name not in kept:
                spec.delete(element)
    pose = _initial_pose(names, file, reference, spec)
    for actuator in reference.actuators:
        spec.add_actuator(
            name=actuator.name,
            trntype=actuator.trntype,
            target=names.joints.get(actuator.target, actuator.target),
            gaintype=actuator.gaintype,
            biastype=actuator.biastype,
            gainprm=actuator.gainprm,
            biasprm=actuator.biasprm,
            gear=actuator.gear,
            ctrllimited=mujoco.mjtLimited.mjLIMITED_FALSE,  # whatever the file's defaults are
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=actuator.forcerange,
        )
    _add_foot_sites(names, reference, spec)
    for sensor in reference.sensors:
        if sensor.name not in names.sensors:
            group = _OBJECT_GROUPS.get(sensor.objtype)
            target = getattr(names, group).get(sensor.objname, sensor.objname) if group else sensor.objname
            spec.add_sensor(name=sensor.name, type=sensor.type, objtype=sensor.objtype, objname=target)
    spec.add_key(name="stand", qpos=pose)


def _require(names: Names, file: Path, spec: mujoco.MjSpec) -> None:
    """Refuses a file that lacks what the task reads."""
    joints = dict.fromkeys(
        f"{side}-{joint}" for side in SIDES for joint in (*MOTORS, *PASSIVE_JOINTS, *DAMPED_JOINTS, *SPRINGS)
    )
    wanted = {
        "joints": tuple(joints),
        "bodies": (PELVIS, *(f"{side}-foot" for side in SIDES)),
        "sites": ("imu",),
        "sensors": tuple(names.sensors),
    }
    for group, ours in wanted.items():
        there = {element.name for element in getattr(spec, group)}
        for name in ours:
            theirs = getattr(names, group).get(name, name)
            if theirs not in there:
                raise ConfigError(
                    f"--model {file}: among its {group} there is no {theirs}; name ours, {name}, with --mapping"
                )
    if not any(geom.contype or geom.conaffinity for geom in spec.worldbody.geoms):
        raise ConfigError(f"--model {file}: it has no ground; expected a scene with a floor")


def _initial_pose(names: Names, file: Path, reference: mujoco.MjSpec, spec: mujoco.MjSpec) -> np.ndarray:
    """Our initial pose joint by joint, [nq of theirs]; joints that we have not keep their reference."""
    ours, theirs = reference.compile(), spec.compile()
    root = theirs.jnt_bodyid[theirs.jnt_qposadr < _ROOT_NUMBERS]
    kinds = [mujoco.mjtJoint(kind).name for kind in theirs.jnt_type[: len(root)]]
    if len(set(root)) != 1 or kinds not in (["mjJNT_FREE"], 3 * ["mjJNT_SLIDE"] + ["mjJNT_BALL"]):
        raise ConfigError(
            f"--model {file}: its first joints are {kinds}; expected a free pelvis, or 3 slides and a ball"
        )
    pose = theirs.qpos0.copy()
    stand = ours.key("stand").qpos
    pose[:_ROOT_NUMBERS] = stand[:_ROOT_NUMBERS]
    there = {theirs.joint(index).name: theirs.jnt_qposadr[index] for index in range(theirs.njnt)}
    for index in range(len(ours.jnt_type)):
        name, start = ours.joint(index).name, ours.jnt_qposadr[index]
        other = there.get(names.joints.get(name, name))
        if start >= _ROOT_NUMBERS and other is not None:
            width = 4 if ours.jnt_type[index] == mujoco.mjtJoint.mjJNT_BALL else 1
            pose[other : other + width] = stand[start : start + width]
    return pose


def _add_foot_sites(names: Names, reference: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Adds the volumes in which the touch sensors count the force on each foot."""
    for side in SIDES:
        site = reference.site(f"{side}-foot-sole")
        foot = spec.body(names.bodies.get(f"{side}-foot", f"{side}-foot"))
        if spec.site(site.name) is None:
            foot.add_site(
                name=site.name, type=site.type, size=site.size, pos=site.pos, quat=site.quat, group=site.group
            )
