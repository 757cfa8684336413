"""How an iteration's budget of environment steps is divided among workers, environments and trajectories."""

from typing import NamedTuple

from hasrl_jax.config.schema import CollectConfig, Config

MOST_ENVS = 128  # environments per worker that are chosen by themselves; what more would gain: docs/performance.md


class Plan(NamedTuple):
    """Sizes of one training process that follow from the configuration and stay fixed for a run."""

    num_workers: int
    envs_per_worker: int
    steps_per_env: int  # environment steps of each environment per iteration
    max_length: int  # T of the trajectories given to the learner
    rows: int  # B of the trajectories given to the learner; more are used when there are more episodes
    carry_shape: tuple[int, int, int]  # (L, 2, W)

    @property
    def steps_per_worker(self) -> int:
        return self.envs_per_worker * self.steps_per_env

    @property
    def env_steps(self) -> int:
        """Environment steps per iteration, all workers of the process together."""
        return self.num_workers * self.steps_per_worker


def make_plan(config: Config) -> Plan:
    """This process's share, rounded up so that every environment collects the same number of steps."""
    collect, processes = config.collect, config.distributed.num_processes
    budget, minibatch = -(-collect.env_steps_per_iteration // processes), config.ppo.minibatch_trajectories // processes
    num_workers, envs_per_worker = collect.num_workers, _envs_per_worker(collect, budget)
    num_envs = num_workers * envs_per_worker
    steps_per_env = -(-budget // num_envs)
    if collect.mode == "unrolls":
        max_length = collect.unroll_length
        steps_per_env = -(-steps_per_env // max_length) * max_length
        rows = num_envs * steps_per_env // max_length
    else:
        max_length = min(collect.max_episode_steps, steps_per_env)
        rows = minibatch  # episodes vary in number: the batch grows by whole minibatches
    rows = -(-rows // minibatch) * minibatch
    return Plan(num_workers, envs_per_worker, steps_per_env, max_length, rows, config.network.carry_shape)


def _envs_per_worker(collect: CollectConfig, budget: int) -> int:
    """The configured number, unless it would make the iteration larger; or else as many as fill `budget` steps.

    Many environments share the cost of every NumPy call.
    """
    if collect.envs_per_worker:
        most = budget // (collect.num_workers * collect.unroll_length)
        return collect.envs_per_worker if collect.mode == "episodes" else max(1, min(collect.envs_per_worker, most))
    length = collect.unroll_length if collect.mode == "unrolls" else collect.max_episode_steps
    trajectories = -(-budget // (collect.num_workers * length))
    rounds = -(-trajectories // MOST_ENVS)
    return -(-trajectories // rounds)
