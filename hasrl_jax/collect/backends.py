"""From `config.backend` and `config.schedule` to a collector."""

from jax.sharding import Mesh

from hasrl_jax.collect.cpu import CpuCollector
from hasrl_jax.collect.decoupled import DecoupledCollector
from hasrl_jax.collect.mjx import MjxCollector
from hasrl_jax.collect.protocol import Collector, Networks
from hasrl_jax.collect.ray.cluster import import_ray
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.task import Task


def make_collector(config: Config, task: Task, mesh: Mesh, networks: Networks) -> Collector:
    """The collector of a configuration.

    Args:
      config: the run's.
      task: that it names.
      mesh: devices of the learner; environments on the accelerator are split over them.
      networks: what these act with.

    Raises:
      ConfigError: Ray is needed and missing, or the settings do not fit the backend.
    """
    if config.backend == "mjx":
        return MjxCollector(config, task, mesh, networks)
    if config.backend == "ray":
        import_ray(config.ray)
    return DecoupledCollector(config, task) if config.schedule == "decoupled" else CpuCollector(config, task)
