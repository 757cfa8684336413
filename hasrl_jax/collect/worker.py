"""A worker process: environments, policy and trajectory buffer on one CPU core.

Started by the pool as `python -m hasrl_jax.collect.worker CONNECTION BLOCK`, two inherited file
descriptors. It imports NumPy and MuJoCo but not JAX, obeys the messages of the pool, and ends when the
pool does.
"""

import ctypes
import io
import json
import os
import signal
import sys
import time
import traceback
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.plan import Plan, make_plan
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.policy import numpy_networks as numpy_policy
from hasrl_jax.types import STEP_FIELDS, Mirror

PR_SET_PDEATHSIG = 1
VALUE_BATCH = 512  # states whose values are computed at once: few calls, and all of it stays in a core's cache


class Actor:
    """The environments of one worker and what they carry from one iteration to the next."""

    def __init__(self, config: Config, plan: Plan, index: int):
        self.config, self.plan, self.index = config, plan, index
        self.task: Task = make_task(config)
        self.mirror: Mirror | None = self.task.mirror if config.network.symmetric else None
        self.envs = CpuEnvs(self.task, plan.envs_per_worker, config.collect.max_episode_steps, timed=True)
        self.state: Any = None  # EnvState once the first collection has begun
        self.carry = np.zeros((plan.envs_per_worker, *plan.carry_shape), np.float32)
        self.stream = config.distributed.process_id * plan.num_workers + index  # no other worker of the run has it

    def collect(
        self, parameters: numpy_policy.Parameters, slot: dict[str, np.ndarray], iteration: int, beat: Any
    ) -> dict[str, Any]:
        """Fills `slot` with `steps_per_env` steps of every environment; returns statistics, with the time it took.

        Steps are stored by environment, then time: index = env * steps_per_env + t.

        Args:
          parameters: the policy and value parameters to act with.
          slot: arrays of `shared_memory.slot_specs`.
          iteration: selects the random stream, so a resumed run draws the same numbers.
          beat: called once per environment step.
        """
        cpu_began, began = time.process_time(), time.monotonic()
        num_envs, horizon = self.plan.envs_per_worker, self.plan.steps_per_env
        rng = np.random.Generator(np.random.Philox(key=[self.config.seed, self.stream], counter=[0, 0, 0, iteration]))
        if self.state is None or self.config.collect.mode == "episodes":
            self.state = self.envs.reset(rng)
        by_env = {
            name: array.reshape(num_envs, horizon, *array.shape[1:])
            for name, array in slot.items()
            if name in STEP_FIELDS or name in shared_memory.EPISODE_FIELDS
        }
        unroll_carries = []
        sums: dict[str, Any] = {"inference": 0.0, "environment": 0.0}
        sums["reward_terms"] = np.zeros(len(self.task.reward_terms))
        physics_before = self.envs.physics_seconds
        log_std = numpy_policy.log_std(parameters, self.mirror)
        noise = rng.standard_normal((horizon, num_envs, self.task.action_size), np.float32)
        deviation = np.exp(log_std) * noise
        for t in range(horizon):
            if t % self.plan.max_length == 0:
                unroll_carries.append(np.where(self.state.is_first[:, None, None, None], np.float32(0), self.carry))
            self._step(parameters, by_env, t, deviation[t], rng, sums)
            beat()
        by_env["log_prob"][:] = numpy_policy.log_prob(noise, log_std).T
        cpu_stepped = time.process_time()
        self._close_buffer(parameters, slot, by_env)
        sums["inference"] += time.process_time() - cpu_stepped
        self._index_segments(slot, by_env, unroll_carries)
        valid = max(int(by_env["mask"].sum()), 1)
        terms = dict(zip(self.task.reward_terms, (sums["reward_terms"] / valid).tolist(), strict=True))
        physics = self.envs.physics_seconds - physics_before
        return {
            "reward_terms": terms,
            "diverged": int((~by_env["mask"]).sum()),
            "seconds": time.monotonic() - began,
            "cpu_seconds": time.process_time() - cpu_began,
            "physics_cpu_seconds": physics,
            "inference_cpu_seconds": sums["inference"],
            "environment_cpu_seconds": sums["environment"] - physics,  # observation, reward and reset
        }

    def _step(
        self,
        parameters: numpy_policy.Parameters,
        by_env: dict,
        t: int,
        deviation: np.ndarray,
        rng: np.random.Generator,
        sums: dict[str, Any],
    ) -> None:
        """One environment step of every environment, written to column `t`; `_close_buffer` adds the rest.

        `deviation` [E, A] is what exploration adds to the mean action.
        """
        state = self.state
        cpu_start = time.process_time()
        inputs = numpy_policy.streams(state.observation, parameters, self.mirror)
        mean, self.carry = numpy_policy.policy_step(parameters, inputs, self.carry, state.is_first, self.mirror)
        action = mean + deviation
        by_env["observation"][:, t] = state.observation
        by_env["is_first"][:, t] = state.is_first
        by_env["action"][:, t] = action
        cpu_acted = time.process_time()
        self.state, result = self.envs.step(state, action, rng)
        sums["inference"] += cpu_acted - cpu_start
        sums["environment"] += time.process_time() - cpu_acted

        valid = ~result.diverged
        by_env["reward"][:, t] = np.where(valid, result.reward, 0.0)
        by_env["terminated"][:, t] = result.terminated
        by_env["truncated"][:, t] = result.truncated
        by_env["mask"][:, t] = valid
        by_env["bootstrap_value"][:, t] = 0.0
        if result.truncated.any():
            cut = np.flatnonzero(result.truncated)
            final = numpy_policy.streams(result.final_observation[cut], parameters, self.mirror)
            by_env["bootstrap_value"][cut, t] = numpy_policy.value(parameters, final)
        ended = result.terminated | result.truncated
        by_env["episode_return"][:, t] = np.where(ended, state.episode_return + result.reward, 0.0)
        by_env["episode_length"][:, t] = np.where(ended, state.episode_step + 1, 0)
        sums["reward_terms"] += result.reward_terms[valid].sum(axis=0)

    def _close_buffer(self, parameters: numpy_policy.Parameters, slot: dict, by_env: dict) -> None:
        """Adds the values, and cuts the last step of every trajectory and the step before a lost one.

        Both bootstrap from the state that follows them, which is the next one recorded.
        """
        observation, value, mask = slot["observation"], slot["value"], by_env["mask"]
        for start in range(0, len(value), VALUE_BATCH):
            some = slice(start, start + VALUE_BATCH)
            value[some] = numpy_policy.value(
                parameters, numpy_policy.streams(observation[some], parameters, self.mirror)
            )
        inputs = numpy_policy.streams(self.state.observation, parameters, self.mirror)
        final = numpy_policy.value(parameters, inputs)
        is_cut = np.zeros_like(mask)
        is_cut[:, :-1] = ~mask[:, 1:] & ~by_env["is_first"][:, 1:]
        if self.config.collect.mode == "unrolls":
            is_cut[:, self.plan.max_length - 1 :: self.plan.max_length] = True
        is_cut[:, -1] = True
        is_cut &= mask & ~by_env["terminated"] & ~by_env["truncated"]
        following = np.concatenate([by_env["value"][:, 1:], final[:, None]], axis=1)
        by_env["truncated"] |= is_cut
        by_env["bootstrap_value"][is_cut] = following[is_cut]

    def _index_segments(self, slot: dict, by_env: dict, unroll_carries: list[np.ndarray]) -> None:
        """Writes the start and end index of each trajectory in the flat buffer, and the carry it starts from."""
        num_envs, horizon, unroll = self.plan.envs_per_worker, self.plan.steps_per_env, self.plan.max_length
        if self.config.collect.mode == "unrolls":
            start = np.arange(0, num_envs * horizon, unroll)
            end = start + unroll
            slot["initial_carry"][:] = np.stack(unroll_carries, axis=1).reshape(len(start), *self.plan.carry_shape)
        else:
            cut = by_env["terminated"] | by_env["truncated"] | ~by_env["mask"]
            cut[:, -1] = True
            end = np.flatnonzero(cut.reshape(-1)) + 1
            start = np.concatenate([[0], end[:-1]])
            slot["initial_carry"][: len(start)] = 0.0
        slot["start"][: len(start)] = start
        slot["end"][: len(end)] = end
        slot["num_segments"][0] = len(start)

    def save(self) -> bytes:
        """Everything the environments carry, as an .npz archive; empty before the first collection."""
        if self.state is None:
            return b""
        buffer = io.BytesIO()
        np.savez(buffer, carry=self.carry, **_flat(self.state))  # type: ignore[arg-type]
        return buffer.getvalue()

    def configured(self, config: Config) -> tuple["Actor", bool]:
        """One with other settings of the task; whether the episodes go on in it.

        They do where their state keeps its shapes and the physics stays: a robot that was drawn at random carries its
        physics step with it.
        """
        actor = Actor(config, self.plan, self.index)
        state = self.save() if config.physics == self.config.physics else b""
        return actor, actor.load(state)

    def load(self, data: bytes) -> bool:
        """Restores what `save` returned; False, and nothing changes, when that was nothing or of other settings."""
        saved = dict(np.load(io.BytesIO(data), allow_pickle=False)) if data else {}
        fresh = self.envs.reset(np.random.default_rng(0))
        wanted = _flat(fresh) | {"carry": self.carry}
        if {name: array.shape for name, array in saved.items()} != {
            name: array.shape for name, array in wanted.items()
        }:
            if self.state is not None:
                self.envs.restore(self.state)
            return False
        self.carry = saved.pop("carry")
        task_state = type(fresh.task)(**{name: saved.pop(f"task/{name}") for name in fresh.task._fields})
        fields = {name: saved.pop(f"model/{name}") for name in fresh.model_fields}
        self.state = EnvState(task=task_state, model_fields=fields, **saved)
        self.envs.restore(self.state)
        return True


def _flat(state: EnvState) -> dict[str, np.ndarray]:
    """The arrays of `state` by name."""
    arrays = {name: getattr(state, name) for name in state._fields if name not in ("task", "model_fields")}
    arrays |= {f"task/{name}": array for name, array in state.task._asdict().items()}
    return arrays | {f"model/{name}": array for name, array in state.model_fields.items()}


def serve(connection: Connection, descriptor: int) -> None:
    """Answers the pool's messages until it says stop or goes away."""
    setup = json.loads(connection.recv_bytes())
    die_with_parent(setup["parent"])
    config = from_dict(setup["config"])
    plan = make_plan(config)
    index = setup["index"]
    actor = Actor(config, plan, index)
    block = shared_memory.open_block(config, plan, actor.task.observation_size, actor.task.action_size, descriptor)

    def beat() -> None:
        block.heartbeat[index] = time.monotonic()

    beat()
    reply(connection, {"ready": True})
    while True:
        message = json.loads(connection.recv_bytes())
        beat()
        if message["do"] == "collect":
            iteration = message["iteration"]
            parameters, slot = block.parameters[message["parameters"]], block.slots[message["slot"]][index]
            reply(connection, actor.collect(parameters, slot, iteration, beat))
        elif message["do"] == "save":
            connection.send_bytes(actor.save())
        elif message["do"] == "configure":
            actor, goes_on = actor.configured(from_dict(message["config"]))
            reply(connection, {"loaded": goes_on})
        elif message["do"] == "load":
            reply(connection, {"loaded": actor.load(connection.recv_bytes())})


def reply(connection: Connection, message: dict) -> None:
    connection.send_bytes(json.dumps(message).encode())


def die_with_parent(parent: int) -> None:
    """Asks the kernel to end this process with the pool's, however that ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the request
        os._exit(0)


def main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # they reach the whole group; the pool decides what to do
        signal.signal(number, signal.SIG_IGN)
    connection = Connection(int(sys.argv[1]))
    try:
        serve(connection, int(sys.argv[2]))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the pool closed the connection: the normal end
    except Exception:
        reply(connection, {"error": traceback.format_exc()})
        sys.exit(1)


if __name__ == "__main__":
    main()
