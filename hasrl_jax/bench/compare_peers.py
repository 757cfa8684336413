"""The other systems of `bench compare`, each in a process of its own that holds no JAX.

`python -m hasrl_jax.bench.compare_peers CONNECTION` is such a process. It starts one sub-process per environment, as
the vector environments of gymnasium and stable-baselines3 do (`sb3_make_vec` steps all of them itself), runs one
iteration whenever it is asked, and ends with everything it started when the connection closes.
"""

import contextlib
import functools
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, Pipe
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from hasrl_jax.collect.worker import die_with_parent, reply
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.registration import ENVIRONMENTS
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import WorkerError
from hasrl_jax.policy.blas import ONE_THREAD

START_TIMEOUT_S = 180.0  # importing torch on a slow disk, then one process per environment
Iterate = Callable[[], tuple[float, float]]  # one iteration: seconds of collecting, seconds of all of it


class PeerProcess:
    """A peer that runs in its own process; use as a context manager.

    Args:
      name: of `PEERS`.
      config: task, physics, sizes and settings of the update.
      num_envs: environments, each in a sub-process of its own.
      env_steps: environment steps per iteration, a multiple of `num_envs` sequences.

    Raises:
      WorkerError: it does not start, or fails later.
    """

    def __init__(self, name: str, config: Config, num_envs: int, env_steps: int):
        self._label = f"{name} with {num_envs} environments"
        self._connection, theirs = Pipe()
        command = [sys.executable, "-W", "ignore", "-m", "hasrl_jax.bench.compare_peers", str(theirs.fileno())]
        self._process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, env=os.environ | ONE_THREAD
        )
        theirs.close()
        try:
            setup = {"name": name, "config": to_dict(config), "parent": os.getpid()}
            self._send(setup | {"num_envs": num_envs, "env_steps": env_steps})
            if not self._connection.poll(START_TIMEOUT_S):
                raise WorkerError(f"{self._label} did not start within {START_TIMEOUT_S:g} s")
            self.parameters: int = self._receive()["parameters"]
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "PeerProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def iterate(self, threads: int) -> tuple[float, float]:
        """One iteration with so many torch threads: seconds of collecting, and of collecting and learning."""
        self._send({"threads": threads})
        answer = self._receive()
        return answer["collect_seconds"], answer["seconds"]

    def close(self) -> None:
        """Ends the process, and with it the environments."""
        self._connection.close()
        try:
            self._process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:  # in the middle of an iteration; the kernel ends its environments
            self._process.kill()
            self._process.wait()

    def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):  # it died: waiting for the answer says so
            self._connection.send_bytes(json.dumps(message).encode())

    def _receive(self) -> dict[str, Any]:
        try:
            answer = json.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            raise WorkerError(f"{self._label} ended with status {self._process.wait()}") from None
        if "error" in answer:
            print(answer["error"], file=sys.stderr)
            raise WorkerError(f"{self._label} failed: {answer['error'].rstrip().splitlines()[-1]}")
        return answer


class WithoutInfo(gymnasium.Wrapper):
    """Drops the info of every step: our reward terms would have to be sent and merged for nobody."""

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return observation, reward, terminated, truncated, {}


def make_env(config: Config, parent: int) -> gymnasium.Env:
    """The environment of `config` as gymnasium registers it; a sub-process of `parent` ends with it."""
    if os.getpid() != parent:
        die_with_parent(parent)
    name = next(name for name, task in ENVIRONMENTS.items() if task == config.task)
    env = gymnasium.make(f"hasrl_jax.envs.gymnasium:{name}", config=config, disable_env_checker=True)
    return WithoutInfo(env)


@contextlib.contextmanager
def sb3(config: Config, num_envs: int, env_steps: int) -> Iterator[tuple[int, Iterate]]:
    """RecurrentPPO of sb3-contrib on a SubprocVecEnv."""
    from stable_baselines3.common.vec_env import SubprocVecEnv

    # Forked, so that a sub-process need not import torch anew; there are no threads yet that a fork could lose.
    envs = SubprocVecEnv([functools.partial(make_env, config, os.getpid())] * num_envs, start_method="fork")
    try:
        yield recurrent_ppo(envs, config, env_steps)
    finally:
        envs.close()


@contextlib.contextmanager
def sb3_make_vec(config: Config, num_envs: int, env_steps: int) -> Iterator[tuple[int, Iterate]]:
    """RecurrentPPO of sb3-contrib on `gymnasium.make_vec`: all environments in this process, in one call."""
    from hasrl_jax.bench.compare_sb3 import BatchVecEnv

    name = next(name for name, task in ENVIRONMENTS.items() if task == config.task)
    mode = AutoresetMode.SAME_STEP  # as stable-baselines3 defines a step
    envs = BatchVecEnv(
        gymnasium.make_vec(f"hasrl_jax.envs.gymnasium:{name}", num_envs, config=config, autoreset_mode=mode)
    )
    try:
        yield recurrent_ppo(envs, config, env_steps)
    finally:
        envs.close()


def recurrent_ppo(envs: Any, config: Config, env_steps: int) -> tuple[int, Iterate]:
    """(number of parameters, one iteration) of sb3-contrib's RecurrentPPO on a vector environment of sb3's kind."""
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.callbacks import BaseCallback

    class Clock(BaseCallback):
        collected = 0.0

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            self.collected = time.perf_counter()

    ppo, hidden = config.ppo, config.network.hidden_size
    model = RecurrentPPO(
        "MlpLstmPolicy",
        envs,
        learning_rate=ppo.policy_learning_rate,
        n_steps=env_steps // envs.num_envs,
        batch_size=ppo.minibatch_trajectories * config.collect.unroll_length,
        n_epochs=ppo.epochs,
        gamma=ppo.discount,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip,
        ent_coef=0.0,
        max_grad_norm=ppo.max_gradient_norm,
        policy_kwargs={
            "lstm_hidden_size": hidden,
            "n_lstm_layers": 2,
            "enable_critic_lstm": False,  # its place takes a linear layer, the first of the three of the value
            "net_arch": {"pi": [], "vf": [hidden]},
            "log_std_init": config.network.initial_log_std,
        },
        seed=config.seed,
        device="cpu",
    )
    clock = Clock()

    def iterate() -> tuple[float, float]:
        started = time.perf_counter()
        model.learn(env_steps, callback=clock, reset_num_timesteps=False)
        return clock.collected - started, time.perf_counter() - started

    return sum(parameter.numel() for parameter in model.policy.parameters()), iterate


@contextlib.contextmanager
def torch_lstm(config: Config, num_envs: int, env_steps: int) -> Iterator[tuple[int, Iterate]]:
    """The PPO of `compare_torch` on gymnasium's AsyncVectorEnv."""
    from gymnasium.vector import AsyncVectorEnv

    constructors = [functools.partial(make_env, config, os.getpid())] * num_envs
    envs = AsyncVectorEnv(constructors, autoreset_mode=AutoresetMode.SAME_STEP)  # no step is spent on a reset
    try:
        from hasrl_jax.bench.compare_torch import Trainer  # after the sub-processes, which need no torch

        learner = Trainer(envs, config.ppo, config.network.hidden_size, config.network.initial_log_std, config.seed)

        def iterate() -> tuple[float, float]:
            started = time.perf_counter()
            batch = learner.collect(env_steps // num_envs, config.collect.unroll_length)
            collected = time.perf_counter()
            learner.update(batch)
            return collected - started, time.perf_counter() - started

        yield learner.parameters, iterate
    finally:
        envs.close()


@contextlib.contextmanager
def torch_update(config: Config, num_envs: int, env_steps: int) -> Iterator[tuple[int, Iterate]]:
    """The update of `compare_torch` alone, on as many sequences of noise as there would be environments."""
    from hasrl_jax.bench.compare_torch import Learner, noise

    task, hidden = make_task(config), config.network.hidden_size
    sizes = task.observation_size, task.action_size
    learner = Learner(*sizes, config.ppo, hidden, config.network.initial_log_std, config.seed)
    batch = noise(learner, num_envs, env_steps // num_envs, hidden)

    def iterate() -> tuple[float, float]:
        started = time.perf_counter()
        learner.update(batch)
        return 0.0, time.perf_counter() - started

    yield learner.parameters, iterate


@contextlib.contextmanager
def single(config: Config, num_envs: int, env_steps: int) -> Iterator[tuple[int, Iterate]]:
    """One environment under random actions in this process: no policy, no transport, no learning."""
    del num_envs
    env, rng = make_env(config, os.getpid()), np.random.default_rng(config.seed)
    std = np.exp(config.network.initial_log_std)
    env.reset(seed=config.seed)

    def iterate() -> tuple[float, float]:
        started = time.perf_counter()
        for _ in range(env_steps):
            _, _, terminated, truncated, _ = env.step(std * rng.standard_normal(env.action_space.shape))
            if terminated or truncated:
                env.reset()
        seconds = time.perf_counter() - started
        return seconds, seconds

    yield 0, iterate
    env.close()


PEERS = {"sb3": sb3, "sb3_make_vec": sb3_make_vec, "torch": torch_lstm, "torch_update": torch_update, "single": single}


def serve(connection: Connection) -> None:
    """Sets up the peer that the first message names, then runs an iteration per message."""
    setup = json.loads(connection.recv_bytes())
    die_with_parent(setup["parent"])
    config = from_dict(setup["config"])
    with PEERS[setup["name"]](config, setup["num_envs"], setup["env_steps"]) as (parameters, iterate):
        reply(connection, {"parameters": parameters})
        while True:
            threads = json.loads(connection.recv_bytes())["threads"]
            if "torch" in sys.modules:
                sys.modules["torch"].set_num_threads(threads)
            collect_seconds, seconds = iterate()
            reply(connection, {"collect_seconds": collect_seconds, "seconds": seconds})


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it reaches the whole group; the benchmark decides what to do
    connection = Connection(int(sys.argv[1]))
    try:
        serve(connection)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the benchmark closed the connection: the normal end
    except Exception:
        reply(connection, {"error": traceback.format_exc()})
        sys.exit(1)


if __name__ == "__main__":
    main()
