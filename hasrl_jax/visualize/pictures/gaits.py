"""A gait library: the paths of a foot over speed, sideways speed and height, and the curves of a leg's motors."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cassie import bezier, gaits
from hasrl_jax.envs.cassie.ids import MOTORS, cassie_ids
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy.numpy_networks import Parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FOOT = "left-foot"  # body
USUAL = {"forward_m_s": 1.0, "lateral_m_s": 0.0, "height_m": 0.9}  # of what a panel does not vary
UNITS = {"forward_m_s": "m/s forward", "lateral_m_s": "m/s to the left", "height_m": "m high"}


def draw(config: Config, parameters: Parameters, seed: int) -> "Figure":
    """The library that a policy was trained with, or that of the package; nothing is played.

    Raises:
      ConfigError: a policy of another task.
    """
    from matplotlib.figure import Figure

    library, model = library_of(config), make_task(config).model
    figure = Figure(figsize=(11, 6.6), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=[1.15, 1.0]))
    views = (("forward_m_s", 0, "x"), ("lateral_m_s", 1, "y"), ("height_m", 0, "x"))
    for axes, (varied, across, name) in zip(above.subplots(1, 3), views, strict=True):
        for value, color in _colored(getattr(library, varied)):
            path = foot_path(library, model, _cell(library, varied, value))
            axes.plot(*path[:, [across, 2]].T, color=color, marker=".", markersize=3, label=f"{value:g}")
        axes.set(title=f"left foot, {UNITS[varied]}", xlabel=f"{name}, m", ylabel="z, m")
        axes.legend(fontsize=7, ncols=2)
        axes.grid(alpha=0.3)
    above.suptitle("paths as seen from the moving robot; otherwise 1 m/s straight on, 0.9 m high", fontsize=9)
    ids, phase = cassie_ids(model), np.linspace(0, 1, 200, endpoint=False)
    for index, axes in enumerate(below.subplots(1, len(MOTORS))):
        for value, color in _colored(library.forward_m_s):
            cell = _cell(library, "forward_m_s", value)
            curve = bezier.value(library.curves[cell][None], phase, np)[:, index]
            states = library.states[cell][:, ids.motor_qpos[index]]
            axes.plot(phase, curve, color=color)
            axes.plot(np.arange(len(states)) / len(states), states, ".", color=color, markersize=2)
        axes.set(title=f"left {MOTORS[index]}, rad", xlabel="phase")
        axes.grid(alpha=0.3)
    below.suptitle("curves of the reference and one recorded cycle (dots), by forward speed", fontsize=9)
    return figure


def library_of(config: Config) -> gaits.Library:
    """The gaits that a policy was trained with, or those of the package.

    Raises:
      ConfigError: a policy of another task.
    """
    if not isinstance(config.settings, CassieConfig):
        raise ConfigError(f"task: the pictures show Cassie's gaits, and the policy is of {config.task!r}")
    return gaits.load(config.settings.reference.gaits or gaits.USUAL)


def foot_path(library: gaits.Library, model: mujoco.MjModel, cell: tuple[int, ...]) -> np.ndarray:
    """Where FOOT is in a cycle, from a point that moves with the mean velocity of the gait: [N + 1, 3] in m, closed."""
    data, path = mujoco.MjData(model), []
    for state in library.states[cell]:
        data.qpos[:] = state[: gaits.QPOS_SIZE]
        mujoco.mj_kinematics(model, data)
        path.append(data.body(FOOT).xpos.copy())
    return np.array([*path, path[0]])


def _cell(library: gaits.Library, varied: str, value: float) -> tuple[int, ...]:
    """Place in the grid of USUAL with one value of another."""
    wanted = USUAL | {varied: value}
    return tuple(int(np.abs(getattr(library, name) - wanted[name]).argmin()) for name in gaits.AXES)


def _colored(values: np.ndarray) -> list[tuple[float, tuple[float, ...]]]:
    """Every value with a color from dark to bright."""
    from matplotlib import colormaps

    return [
        (float(value), colormaps["viridis"](0.9 * place))
        for value, place in zip(values, np.linspace(0, 1, len(values)), strict=True)
    ]
