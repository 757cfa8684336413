"""The robot's MJCF file with the physics of a configuration in it, to play a policy beside this package."""

from pathlib import Path
from xml.etree import ElementTree

from hasrl_jax.config.schema import PhysicsConfig
from hasrl_jax.deploy.files import write_whole
from hasrl_jax.errors import ConfigError


def write(path: Path, asset: Path, physics: PhysicsConfig) -> None:
    """Copies `asset` with the time step, solver, integrator and iterations of `physics`.

    Ground that changes by episode is not in it: the floor is level.

    Raises:
      ConfigError: the model refers to other files; CheckpointError: the file cannot be written.
    """
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
    write_whole(path, ElementTree.tostring(root, encoding="utf-8") + b"\n")
