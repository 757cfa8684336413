"""The fields of a configuration: frozen dataclasses with the limits of every number beside it.

A YAML file names only what it changes from these defaults. A task's own settings are a further group under the task's
name, see `config/tasks.py`. Every field is read somewhere, and its comment gives its meaning and unit.
"""

import os
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from hasrl_jax.config.limits import Limits, Share


def available_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class PhysicsConfig:
    timestep_s: Annotated[float, Limits(1e-5, 0.01)] = 0.0025  # physics step, seconds (the paper: 0.0005)
    # physics steps per environment (policy) step (the paper: 50)
    steps_per_env_step: Annotated[int, Limits(1, 10_000)] = 10
    solver: Literal["Newton", "CG", "PGS"] = "Newton"  # constraint solver
    integrator: Literal["Euler", "implicitfast"] = "implicitfast"  # implicitfast is stable at 2.5 ms
    solver_iterations: Annotated[int, Limits(1, 10_000)] = 4  # constraint solver iterations, at most
    # line-search iterations per solver iteration, at most
    line_search_iterations: Annotated[int, Limits(1, 10_000)] = 8

    @property
    def env_step_s(self) -> float:
        """Nominal duration of one environment step, seconds."""
        return self.timestep_s * self.steps_per_env_step


@dataclass(frozen=True)
class NetworkConfig:
    # of the policy: two LSTM layers, or two tanh layers without memory, which show what the memory is for
    memory: Literal["lstm", "none"] = "lstm"
    hidden_size: Annotated[int, Limits(1, 8192)] = 128  # width of each policy layer and of each value layer
    initial_log_std: Annotated[float, Limits(-10, 3)] = 0.0  # log of the exploration standard deviation at the start
    learn_std: bool = True  # train the standard deviation; otherwise it stays at its start, or what a stage sets
    normalize_observations: bool = True  # running mean and variance, part of the checkpoint
    symmetric: bool = False  # mirror-equivariant policy and mirror-invariant value by construction

    @property
    def carry_shape(self) -> tuple[int, int, int]:
        """(L, 2, W) of one LSTM carry: layers (0 without memory), (h, c), and the width of all streams side by side."""
        return 2 if self.memory == "lstm" else 0, 2, self.hidden_size * (2 if self.symmetric else 1)


@dataclass(frozen=True)
class CollectConfig:
    # worker processes; the default is one per core
    num_workers: Annotated[int, Limits(1, 4096)] = field(default_factory=available_cores)
    # environments stepped together by one worker; 0 takes what the iteration fills, to 128
    envs_per_worker: Annotated[int, Limits(0, 65536)] = 0
    # environment steps per iteration, all workers together
    env_steps_per_iteration: Annotated[int, Limits(1, 10**9)] = 16384
    mode: Literal["unrolls", "episodes"] = "unrolls"  # fixed-length pieces, or whole episodes from a fresh reset
    unroll_length: Annotated[int, Limits(1, 10**6)] = 64  # environment steps per trajectory in `unrolls` mode
    max_episode_steps: Annotated[int, Limits(1, 10**6)] = 400  # time limit of an episode, environment steps
    worker_start_timeout_s: Annotated[float, Limits(1, 86400)] = 60.0  # a worker must report ready within this time
    # a worker silent for this long while collecting is replaced
    worker_timeout_s: Annotated[float, Limits(1, 86400)] = 20.0


@dataclass(frozen=True)
class RayConfig:
    address: str = ""  # of a running Ray cluster, HOST:PORT; empty starts Ray on this machine alone


@dataclass(frozen=True)
class DistributedConfig:
    coordinator: str = ""  # HOST:PORT that process 0 listens on; empty when one process trains alone
    # training processes that share one learner, usually one per host
    num_processes: Annotated[int, Limits(1, 4096)] = 1
    process_id: Annotated[int, Limits(0, 4095)] = 0  # of this process, from 0; process 0 writes the run directory
    start_timeout_s: Annotated[float, Limits(1, 86400)] = 120.0  # all processes must have joined within this time


@dataclass(frozen=True)
class MjxConfig:
    num_envs: Annotated[int, Limits(1, 10**6)] = 2048  # environments over all devices, a multiple of their number
    impl: Literal["jax", "warp"] = "jax"  # any device, or MuJoCo Warp on NVIDIA
    # Warp: room for contacts, shared by a device's environments, per environment
    contacts_per_env: Annotated[int, Limits(1, 10_000)] = 16
    constraints_per_env: Annotated[int, Limits(1, 10_000)] = 64  # Warp: most constraint rows of one environment


@dataclass(frozen=True)
class PPOConfig:
    epochs: Annotated[int, Limits(1, 1000)] = 5  # passes over the data of an iteration
    minibatch_trajectories: Annotated[int, Limits(1, 10**6)] = 64  # trajectories per minibatch
    policy_learning_rate: Annotated[float, Limits(1e-12, 1)] = 3e-4  # Adam step size of the policy
    value_learning_rate: Annotated[float, Limits(1e-12, 1)] = 1e-3  # Adam step size of the value network
    learning_rate_schedule: Literal["constant", "linear"] = "constant"  # linear goes to zero at total_env_steps
    adam_epsilon: Annotated[float, Limits(1e-16, 1)] = 1e-5  # Adam epsilon
    max_gradient_norm: Annotated[float, Limits(1e-6, 1e9)] = 0.5  # global-norm clip, each network on its own
    clip: Annotated[float, Limits(0.001, 0.999)] = 0.2  # epsilon of the clipped surrogate
    entropy_coefficient: Annotated[float, Limits(0, 1e3)] = 0.0  # c1
    value_coefficient: Annotated[float, Limits(1e-6, 1e6)] = 1.0  # c2
    discount: Share = 0.97  # gamma
    advantage: Literal["gae", "return"] = "gae"  # GAE, or discounted return minus value (paper Eq. 2)
    gae_lambda: Share = 0.95  # lambda of GAE
    standardize_advantages: bool = True  # zero mean, unit standard deviation over the iteration
    # skip the rest of the policy updates of an iteration beyond this KL; 0 never skips
    max_kl: Annotated[float, Limits(0, 1e6)] = 0.03
    mask_padding: bool = True  # False copies the published losses, which average over padding


@dataclass(frozen=True)
class DecoupledConfig:
    max_lag: Annotated[int, Limits(0, 10**6)] = 4  # versions; trajectories of older parameters are dropped
    # updates a trajectory may enter on average; above 1, the newest ones again while waiting
    replay_ratio: Annotated[float, Limits(1, 100)] = 1.0
    max_importance: Annotated[float, Limits(1, 1e6)] = 2.0  # importance weights of stale steps are cut off here


@dataclass(frozen=True)
class EvaluateConfig:
    # evaluate the mean action every this many iterations; 0 never
    every_iterations: Annotated[int, Limits(0, 10**9)] = 20
    episodes: Annotated[int, Limits(1, 10**5)] = 16  # episodes per evaluation


@dataclass(frozen=True)
class VideoConfig:
    # film the policy every this many iterations into films/ of the run, by a process of its own; 0 never
    every_iterations: Annotated[int, Limits(0, 10**9)] = 0
    seconds: Annotated[float, Limits(0.1, 600)] = 8.0  # length of a film, s
    width: Annotated[int, Limits(64, 4096)] = 320  # pixels, an even number
    height: Annotated[int, Limits(64, 4096)] = 240  # pixels, an even number


@dataclass(frozen=True)
class TrackConfig:
    to: tuple[Literal["wandb", "mlflow"], ...] = ()  # trackers beside TensorBoard; each is an extra of the package
    project: str = "hasrl_jax"  # W&B's project, MLflow's experiment
    name: str = ""  # of the run there; empty takes that of its directory
    offline: bool = True  # W&B: keep everything in the run directory, for `wandb sync`


@dataclass(frozen=True)
class CheckpointConfig:
    every_iterations: Annotated[int, Limits(0, 10**9)] = 20  # save every this many iterations (and always at the end)
    keep: Annotated[int, Limits(1, 10**6)] = 3  # newest checkpoints kept


@dataclass(frozen=True)
class StageConfig:
    """A change of settings on the way, see `config/curriculum.py`."""

    # the stage begins when the run has collected so many environment steps
    at_env_steps: Annotated[int, Limits(1, 10**15)] = 1
    set: dict[str, Any] = field(default_factory=dict)  # dotted field -> value, in force from then on
    # metric -> its least mean over the last iterations; the stage also waits for all of them
    wait_for: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Config:
    """A run. Made by `convert.from_dict`, which adds the group of settings that the task has."""

    section: ClassVar[str] = ""  # name of that group; empty where the task has none

    task: str = "cassie"  # a task by name, or MODULE:NAME of a `config.tasks.TaskSpec`
    backend: Literal["cpu_pool", "ray", "mjx"] = "cpu_pool"  # CPU processes, Ray actors, or the accelerator
    schedule: Literal["sync", "overlap", "decoupled"] = "sync"  # collect, then train; collect one ahead; independently
    seed: Annotated[int, Limits(0, 2**63 - 1)] = 0  # seeds every random stream
    total_env_steps: Annotated[int, Limits(1, 10**15)] = 50_000_000  # training ends after this many environment steps
    stages: tuple[StageConfig, ...] = ()  # settings that change on the way
    compilation_cache: bool = True  # keep compiled programs in the user's cache directory
    run_dir: str = ""  # where the run is written; empty makes runs/<task>-<time>
    private: bool = False  # the directory of a new run is open to its owner alone
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    collect: CollectConfig = field(default_factory=CollectConfig)
    ray: RayConfig = field(default_factory=RayConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)
    mjx: MjxConfig = field(default_factory=MjxConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    decoupled: DecoupledConfig = field(default_factory=DecoupledConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    @property
    def settings(self) -> Any:
        """The task's own settings; None where it has none."""
        return getattr(self, self.section) if self.section else None
