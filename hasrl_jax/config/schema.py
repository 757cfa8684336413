"""Configuration: frozen dataclasses, strict YAML, and checks that run before anything compiles.

A YAML file names only what it changes from the defaults of these classes. Training without `--config` reads
`configs/cassie_walk.yaml`. Every field is read somewhere, and its comment gives its meaning and unit.
"""

import contextlib
import dataclasses
import math
import os
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from hasrl_jax.config import strict_yaml
from hasrl_jax.envs.cassie.settings import CassieConfig
from hasrl_jax.errors import ConfigError


def available_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _config_folder() -> Path:
    """configs/, beside the package in a checkout and inside it in a wheel."""
    package = Path(__file__).parents[1]
    folders = package.parent / "configs", package / "configs"
    return next((folder for folder in folders if folder.is_dir()), folders[0])


CONFIG_FOLDER = _config_folder()
DEFAULT_CONFIG = CONFIG_FOLDER / "cassie_walk.yaml"


@dataclass(frozen=True)
class PhysicsConfig:
    timestep_s: float = 0.0025  # physics step, seconds (the paper: 0.0005)
    steps_per_env_step: int = 10  # physics steps per environment (policy) step (the paper: 50)
    solver: Literal["Newton", "CG", "PGS"] = "Newton"  # constraint solver
    integrator: Literal["Euler", "implicitfast"] = "implicitfast"  # implicitfast is stable at 2.5 ms
    solver_iterations: int = 4  # constraint solver iterations, at most
    line_search_iterations: int = 8  # line-search iterations per solver iteration, at most

    @property
    def env_step_s(self) -> float:
        """Nominal duration of one environment step, seconds."""
        return self.timestep_s * self.steps_per_env_step


@dataclass(frozen=True)
class NetworkConfig:
    hidden_size: int = 128  # width of each LSTM layer and of each value layer
    initial_log_std: float = 0.0  # log of the exploration standard deviation at the start
    learn_std: bool = True  # train the standard deviation; otherwise it stays at its start
    normalize_observations: bool = True  # running mean and variance, part of the checkpoint
    symmetric: bool = False  # mirror-equivariant policy and mirror-invariant value by construction

    @property
    def carry_shape(self) -> tuple[int, int, int]:
        """(L, 2, W) of one LSTM carry: layers, (h, c), and the width of all streams side by side."""
        return 2, 2, self.hidden_size * (2 if self.symmetric else 1)


@dataclass(frozen=True)
class CollectConfig:
    num_workers: int = field(default_factory=available_cores)  # worker processes; the default is one per core
    envs_per_worker: int = 0  # environments stepped together by one worker; 0 takes what the iteration fills, to 128
    env_steps_per_iteration: int = 16384  # environment steps per iteration, all workers together
    mode: Literal["unrolls", "episodes"] = "unrolls"  # fixed-length pieces, or whole episodes from a fresh reset
    unroll_length: int = 64  # environment steps per trajectory in `unrolls` mode
    max_episode_steps: int = 400  # time limit of an episode, environment steps
    worker_start_timeout_s: float = 60.0  # a worker must report ready within this time
    worker_timeout_s: float = 20.0  # a worker silent for this long while collecting is replaced


@dataclass(frozen=True)
class RayConfig:
    address: str = ""  # of a running Ray cluster, HOST:PORT; empty starts Ray on this machine alone


@dataclass(frozen=True)
class DistributedConfig:
    coordinator: str = ""  # HOST:PORT that process 0 listens on; empty when one process trains alone
    num_processes: int = 1  # training processes that share one learner, usually one per host
    process_id: int = 0  # of this process, from 0; process 0 writes the run directory
    start_timeout_s: float = 120.0  # all processes must have joined within this time


@dataclass(frozen=True)
class MjxConfig:
    num_envs: int = 2048  # environments over all devices, a multiple of their number
    impl: Literal["jax", "warp"] = "jax"  # any device, or MuJoCo Warp on NVIDIA
    contacts_per_env: int = 16  # Warp: room for contacts, shared by a device's environments, per environment
    constraints_per_env: int = 64  # Warp: most constraint rows of one environment


@dataclass(frozen=True)
class PPOConfig:
    epochs: int = 5  # passes over the data of an iteration
    minibatch_trajectories: int = 64  # trajectories per minibatch
    policy_learning_rate: float = 3e-4  # Adam step size of the policy
    value_learning_rate: float = 1e-3  # Adam step size of the value network
    learning_rate_schedule: Literal["constant", "linear"] = "constant"  # linear goes to zero at total_env_steps
    adam_epsilon: float = 1e-5  # Adam epsilon
    max_gradient_norm: float = 0.5  # global-norm clip, each network on its own
    clip: float = 0.2  # epsilon of the clipped surrogate
    entropy_coefficient: float = 0.0  # c1
    value_coefficient: float = 1.0  # c2
    discount: float = 0.97  # gamma
    advantage: Literal["gae", "return"] = "gae"  # GAE, or discounted return minus value (paper Eq. 2)
    gae_lambda: float = 0.95  # lambda of GAE
    standardize_advantages: bool = True  # zero mean, unit deviation over the iteration
    max_kl: float = 0.03  # skip the rest of the policy updates of an iteration beyond this KL; 0 never skips
    mask_padding: bool = True  # False copies the published losses, which average over padding


@dataclass(frozen=True)
class DecoupledConfig:
    max_lag: int = 4  # versions; trajectories of older parameters are dropped
    replay_ratio: float = 1.0  # updates a trajectory may enter on average; above 1, the newest ones again while waiting
    max_importance: float = 2.0  # importance weights of stale steps are cut off here


@dataclass(frozen=True)
class EvaluateConfig:
    every_iterations: int = 20  # evaluate the mean action every this many iterations; 0 never
    episodes: int = 16  # episodes per evaluation


@dataclass(frozen=True)
class CheckpointConfig:
    every_iterations: int = 20  # save every this many iterations (and always at the end)
    keep: int = 3  # newest checkpoints kept


@dataclass(frozen=True)
class Config:
    task: Literal["cassie", "cartpole"] = "cassie"  # which task definition
    backend: Literal["cpu_pool", "ray", "mjx"] = "cpu_pool"  # CPU processes, Ray actors, or the accelerator
    schedule: Literal["sync", "overlap", "decoupled"] = "sync"  # collect, then train; collect one ahead; independently
    seed: int = 0  # seeds every random stream
    total_env_steps: int = 50_000_000  # training ends after this many environment steps
    stages: tuple[str, ...] = ()  # settings that change on the way, "STEPS FIELD=VALUE ..."; see curriculum.py
    compilation_cache: bool = True  # keep compiled programs in the user's cache directory
    run_dir: str = ""  # where the run is written; empty makes runs/<task>-<time>
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    cassie: CassieConfig = field(default_factory=CassieConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    ray: RayConfig = field(default_factory=RayConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    mjx: MjxConfig = field(default_factory=MjxConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    decoupled: DecoupledConfig = field(default_factory=DecoupledConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)  # stays the last: it shows a file is whole


def to_dict(config: Any) -> dict[str, Any]:
    """The configuration as plain dicts, lists and scalars, ready for YAML or JSON."""
    return {
        f.name: to_dict(value)
        if dataclasses.is_dataclass(value)
        else list(value)
        if isinstance(value, tuple)
        else value
        for f in dataclasses.fields(config)
        for value in [getattr(config, f.name)]
    }


def from_dict(values: Any, base: Any = None, where: str = "config") -> Any:
    """`base` (default: `Config()`) with the fields named in `values` replaced.

    Raises:
      ConfigError: an unknown key or a value of another type; the message names the dotted path.
    """
    base = Config() if base is None else base
    if not isinstance(values, dict):
        raise ConfigError(f"{where}: expected a mapping of fields, got {shown(values)}")
    hints = typing.get_type_hints(type(base))
    changes = {}
    for key, value in values.items():
        path = f"{where}.{key}"
        if key not in hints:
            raise ConfigError(f"{path}: unknown field; known fields are {', '.join(hints)}")
        current = getattr(base, key)
        changes[key] = (
            from_dict(value, current, path) if dataclasses.is_dataclass(current) else _convert(value, hints[key], path)
        )
    return dataclasses.replace(base, **changes)


def _convert(value: Any, hint: Any, path: str) -> Any:
    """`value` as the annotated type `hint`, or a ConfigError naming `path`."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        if value in args:
            return value
        raise ConfigError(f"{path}: got {shown(value)}; expected one of {', '.join(map(repr, args))}")
    if origin is tuple and args[-1] is Ellipsis:
        if isinstance(value, list | tuple):
            return tuple(_convert(v, args[0], f"{path}[{i}]") for i, v in enumerate(value))
        raise ConfigError(f"{path}: got {shown(value)}; expected a list")
    if origin is tuple:
        if isinstance(value, list | tuple) and len(value) == len(args):
            return tuple(_convert(v, a, f"{path}[{i}]") for i, (v, a) in enumerate(zip(value, args, strict=True)))
        raise ConfigError(f"{path}: got {shown(value)}; expected a list of {len(args)} numbers")
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 1e-4 as a string
        with contextlib.suppress(ValueError):
            value = float(value)
    accepted: Any = {float: (int, float), int: int, bool: bool, str: str}[hint]
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ConfigError(f"{path}: got {shown(value)}; expected {hint.__name__}")
    try:
        finite = math.isfinite(value) if hint is float else True
    except OverflowError:  # an integer beyond the largest float
        finite = False
    if not finite:
        raise ConfigError(f"{path}: got {shown(value)}; expected a finite number")
    return hint(value)


def shown(value: Any) -> str:
    """`value` as an error message shows it: on one line, and short."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}… ({len(text)} characters)"


def load_yaml(path: str | Path) -> Config:
    """Reads a YAML file over the defaults.

    Raises:
      ConfigError: missing or unreadable file, invalid YAML, a key given twice, unknown fields or wrong types.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    try:
        values = strict_yaml.parse(text)
    except ValueError as error:
        raise ConfigError(f"--config {path}: {error}") from None
    return from_dict({} if values is None else values, where=Path(path).name)


def shipped(name: str) -> Config:
    """The configuration of `configs/<name>.yaml`."""
    return load_yaml(CONFIG_FOLDER / f"{name}.yaml")


def dump_yaml(config: Config) -> str:
    """The resolved configuration as YAML text."""
    return yaml.safe_dump(to_dict(config), sort_keys=False)
