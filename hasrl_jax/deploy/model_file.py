"""The robot's MJCF file with the physics of a configuration in it, to play a policy beside this package."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco

from hasrl_jax.config.schema import PhysicsConfig
from hasrl_jax.deploy.files import write_whole
from hasrl_jax.envs import motors
from hasrl_jax.envs.task import Task
from hasrl_jax.errors import ConfigError


def write(path: Path, task: Task, physics: PhysicsConfig) -> None:
    """Copies the task's MJCF with the time step, solver, integrator and iterations of `physics`, and its motors.

    Ground that changes by episode is not in it: the floor is level.

    Raises:
      ConfigError: the model refers to other files; CheckpointError: the file cannot be written.
    """
    asset = task.asset
    root = ElementTree.parse(asset).getroot()
    other = next((element.get("file") for element in root.iter() if element.get("file")), None)
    if other:
        raise ConfigError(f"--model: {asset} refers to {other}; expected a model in a single file")
    option = root.find("option")
    if option is None:
        option = ElementTree.SubElement(root, "option")
    option.set("timestep", repr(physics.timestep_s))
    option.set("solver", physics.solver)
    option.set("integrator", physics.integrator)
    option.set("iterations", str(physics.solver_iterations))
    option.set("ls_iterations", str(physics.line_search_iterations))
    if motors.curve_of(task.model):
        _set_motors(root, task.model)
    write_whole(path, ElementTree.tostring(root, encoding="utf-8") + b"\n")


def _set_motors(root: ElementTree.Element, model: mujoco.MjModel) -> None:
    """Makes the actuators of a description the DC motors of `model`."""
    for element in root.findall("actuator/general"):
        numbers = model.actuator_gainprm[model.actuator(element.get("name")).id]
        element.attrib.pop("biasprm", None)
        element.set("gainprm", " ".join(repr(float(number)) for number in numbers))
        element.set("dynprm", "0")
        element.set("input", "pos")
        element.set("actearly", "true")
        for kind in ("dyntype", "gaintype", "biastype"):
            element.set(kind, "dcmotor")
