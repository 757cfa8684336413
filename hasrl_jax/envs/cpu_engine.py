"""Many environments stepped together by C MuJoCo in one call, or a lone one; the engine behind the CPU pool.

Shapes begin with the number of environments, written E. A lone environment has arrays without that axis: NumPy takes
as long for an array of one number as for one of fifty, and a fraction of that for a scalar.

Every number that describes the environments is an array in `EnvState`, so saving and restoring them
is copying arrays. Randomness comes in as a NumPy generator; the environments hold none.
"""

import time
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from hasrl_jax.envs.draws import anywhere
from hasrl_jax.envs.layout import summed
from hasrl_jax.envs.model import without_islands
from hasrl_jax.envs.task import Reading, Reset, Task
from hasrl_jax.errors import DivergenceError
from hasrl_jax.types import Array

PHYSICS_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
RECORD = ("sensordata",)
SPLIT_FROM = 8  # environments from which sensors left out save more than the second call that this takes

# Warnings of a simulation that went bad; a full buffer of contacts is none.
_BAD = [
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_INERTIA,
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_BADCTRL,
    )
]


class EnvState(NamedTuple):
    """The complete state of E environments."""

    physics: np.ndarray  # [E, nstate] float64: time, qpos, qvel, act (mjSTATE_FULLPHYSICS)
    task: Any  # the task's NamedTuple of arrays [E, ...]
    model_fields: dict[str, np.ndarray]  # randomised MjModel fields [E, ...]
    observation: np.ndarray  # [E, O] the observation that the policy sees next
    is_first: np.ndarray  # [E] bool: that observation opens an episode
    episode_step: np.ndarray  # [E] int64 environment steps since reset
    episode_return: np.ndarray  # [E] sum of rewards since reset


class StepResult(NamedTuple):
    """What one environment step of E environments produced."""

    reward: Array  # [E]
    terminated: Array  # [E] bool
    truncated: Array  # [E] bool: the time limit
    diverged: Array  # [E] bool: the simulation failed, or the task did; nothing of this step is valid
    final_observation: Array  # [E, O] the true next observation, also where a new episode begins
    reward_terms: Array  # [E, R]
    measures: Array  # [E, M]


class CpuEnvs:
    """E copies of a task, each with fields of the model to itself if episodes randomise them.

    Fresh episodes are prepared E at a time, because drawing many costs little more than drawing one. Those that are
    left never outlive the generator they were drawn from, so results depend on states and generators alone.

    Args:
      task: the definition to run.
      num_envs: E; None for a lone environment, whose arrays lack that axis.
      max_episode_steps: time limit in environment steps.
      pushable: whether `Task.with_push` may be used on a task that is not disturbed by itself.
      timed: whether `physics_seconds` is counted.
    """

    def __init__(
        self, task: Task, num_envs: int | None, max_episode_steps: int, pushable: bool = False, timed: bool = False
    ):
        # `step` reports a diverged simulation; MuJoCo would also write it to a file in the working directory.
        mujoco.set_mju_user_warning(lambda text: None)
        self.task = task
        self.max_episode_steps = max_episode_steps
        self.num_envs = num_envs or 1
        self._shape = () if num_envs is None else (num_envs,)
        self._all: Any = 0 if num_envs is None else slice(None)  # the environments in an array of the batch
        self._timestep = task.model.opt.timestep
        self._timed = timed
        self.physics_seconds = 0.0  # CPU time spent inside MuJoCo so far
        self._prepared: Reset | None = None  # E fresh episodes
        self._taken = 0  # of the prepared episodes
        self._source: Any = None  # the generator that drew them
        # On the calling thread: a core a worker.
        self._batch = Batch(without_islands(task.model), self.num_envs, nthread=1)
        self._fields: dict[str, np.ndarray] = {}  # randomised field -> its values [E, ...] in the batch
        size = mujoco.mj_stateSize(task.model, PHYSICS_STATE)
        self._physics = self._batch.state[self._all, :size]
        nq, nv = task.model.nq, task.model.nv
        self._qpos, self._qvel = slice(1, 1 + nq), slice(1 + nq, 1 + nq + nv)  # in the physics state
        self._warm_start = self._batch.bind("qacc_warmstart")
        self._inputs = self._batch.bind("ctrl")
        self._applied = self._batch.bind("qfrc_applied")
        self._warnings = self._batch.warning[..., 1]  # [E, warnings] how often each was given
        self._none = np.zeros(self._shape, bool)
        self._late = [task.model.sensor(name).id for name in task.end_sensors]
        steps = task.steps_per_env_step
        split = bool(self._late) and steps > 1 and self.num_envs >= SPLIT_FROM
        self._parts = (steps - 1, 1) if split else (steps,)  # physics steps of each call
        self._stages = self._batch.expand("sensor_needstage") if split else None  # [E, sensors]
        self._records: list[dict[Any, np.ndarray]] = [{} for _ in self._parts]
        self._force = task.force if task.disturbed or pushable else None

    def reset(self, rng: np.random.Generator) -> EnvState:
        """Fresh episodes in all environments."""
        fresh = self._fresh(rng)
        state = EnvState(
            physics=_physics(fresh, self.task.model.na),
            task=fresh.state,
            model_fields=fresh.model_fields,
            observation=fresh.observation,
            is_first=np.ones(self._shape, bool),
            episode_step=np.zeros(self._shape, np.int64),
            episode_return=np.zeros(self._shape),
        )
        self.restore(state)
        return state

    def restore(self, state: EnvState) -> None:
        """Writes the randomised fields of `state` into the batch, as `step` expects to find them."""
        self._prepared = None
        self._write_fields(slice(None), state.model_fields, ...)

    def step(self, state: EnvState, action: np.ndarray, rng: np.random.Generator) -> tuple[EnvState, StepResult]:
        """One environment step; environments whose episode ended are reset.

        Args:
          state: as returned by `reset` or by the previous `step`.
          action: [E, A].
          rng: source of the uniform numbers that the task consumes.

        Raises:
          DivergenceError: an action is not finite.
        """
        if not np.isfinite(action).all():
            raise DivergenceError("the policy produced an action that is not finite")
        task = self.task
        physics, reading, warned = self._simulate(state, self._control(state, action))
        result = task.step(state.task, action, reading, rng.random((*self._shape, task.step_uniforms)), np)
        # Nor may what the task makes of a good simulation spoil a whole batch, or the statistics of the observations.
        # A sum is finite where all its numbers are.
        checked = summed(physics, np) + summed(reading.sensordata, np) + summed(result.observation, np) + result.reward
        diverged = warned | ~np.isfinite(checked)
        episode_step = state.episode_step + 1
        terminated = result.terminated & ~diverged
        truncated = (episode_step >= self.max_episode_steps) & ~(terminated | diverged)
        step_result = StepResult(
            result.reward, terminated, truncated, diverged, result.observation, result.reward_terms, result.measures
        )
        state = EnvState(
            physics=physics,
            task=result.state,
            model_fields=state.model_fields,
            observation=result.observation,
            is_first=np.zeros(self._shape, bool),
            episode_step=episode_step,
            episode_return=state.episode_return + result.reward,
        )
        ended = terminated | truncated | diverged
        if not anywhere(ended):
            return state, step_result
        return self._reset_some(state, np.flatnonzero(ended), rng) if self._shape else self.reset(rng), step_result

    def _control(self, state: EnvState, action: np.ndarray) -> np.ndarray:
        """Controls of the physics steps of an environment step, [E, S, nu], or [E, 1, nu] where all are the same."""
        task = self.task
        control = task.control(state.task, action, np)[..., None, :]
        if task.delay is None:
            return control
        earlier, delay_s = task.delay(state.task, np)
        delay_steps = delay_s / self._physics_step_s(state)
        late = np.arange(task.steps_per_env_step) + 0.5 < delay_steps[..., None]
        return np.where(late[..., None], task.control(state.task, earlier, np)[..., None, :], control)

    def _physics_step_s(self, state: EnvState) -> np.ndarray | float:
        """Physics step within the coming environment step, s, [E] or the same for all."""
        timestep = state.model_fields.get("timestep", self._timestep)
        return timestep if self.task.pace is None else timestep * self.task.pace(state.task, np)

    def keep(self, before: EnvState, after: EnvState, envs: np.ndarray, fields: bool = True) -> EnvState:
        """`after` with the environments numbered `envs` as they were `before`.

        `fields`: their models, too; without it the state is only for looking at, or no episode ended in between.
        """

        def put(new: np.ndarray, old: np.ndarray) -> np.ndarray:
            new = new.copy()
            new[envs] = old[envs]
            return new

        if fields:
            self._write_fields(envs, before.model_fields, envs)
        return EnvState(
            physics=put(after.physics, before.physics),
            task=type(after.task)(*map(put, after.task, before.task)),
            model_fields={name: put(values, before.model_fields[name]) for name, values in after.model_fields.items()},
            observation=put(after.observation, before.observation),
            is_first=put(after.is_first, before.is_first),
            episode_step=put(after.episode_step, before.episode_step),
            episode_return=put(after.episode_return, before.episode_return),
        )

    def _simulate(self, state: EnvState, control: np.ndarray) -> tuple[np.ndarray, Reading, np.ndarray]:
        """Runs the physics steps of one environment step under `control`, [E, S or 1, nu].

        Returns:
          The physics state, what the task reads of it, and which simulations MuJoCo gave up, [E] bool.
        """
        task = self.task
        if task.pace:
            self._field("timestep")[:] = self._physics_step_s(state)
        if self._force:
            self._applied[:] = self._force(state.task, np)
        self._physics[:] = state.physics
        self._warm_start[:] = 0.0  # what is simulated depends on the state alone
        cpu = time.thread_time() if self._timed else 0.0  # MuJoCo runs on this thread
        self._run(control)
        if self._timed:
            self.physics_seconds += time.thread_time() - cpu
        sensed = [record["sensordata"][self._all] for record in self._records]  # [E, S, nsensordata] each
        end, sensordata = self._physics.copy(), sensed[-1][..., -1, :].copy()
        # MuJoCo resets a simulation that went bad to a finite state, and counts it.
        warned = self._none
        if np.count_nonzero(self._warnings):
            warned = self._warnings[self._all][..., _BAD].any(axis=-1)
            self._warnings[:] = 0
        features, *more = [np.add.reduce(task.physics_features(part, np), axis=-2) for part in sensed]
        averages = sum(more, features) / task.steps_per_env_step
        return end, Reading(end[..., self._qpos], end[..., self._qvel], sensordata, averages), warned

    def _run(self, control: np.ndarray) -> None:
        """All physics steps under `control`, [E, S or 1, nu]; sensors that only the last one needs wait for it."""
        first, held = 0, control.shape[-2] == 1
        if held:
            self._inputs[:] = control[..., 0, :]
        for steps, record in zip(self._parts, self._records, strict=True):
            if self._stages is not None:
                late = self.task.model.sensor_needstage[self._late] if first else mujoco.mjtStage.mjSTAGE_NONE.value
                self._stages[:, self._late] = late
            part = None if held else control[..., first : first + steps, :]
            record |= self._batch.rollout(steps, part, record=RECORD, out=record)
            first += steps

    def _fresh(self, rng: np.random.Generator) -> Reset:
        """An episode for every environment."""
        return self.task.reset(rng.random((*self._shape, self.task.reset_uniforms)), np)

    def _reset_some(self, state: EnvState, envs: np.ndarray, rng: np.random.Generator) -> EnvState:
        """`state` with fresh episodes in the environments numbered `envs`; takes over its arrays where it owns them."""
        if self._prepared is None or self._source is not rng or self._taken + len(envs) > self.num_envs:
            self._prepared = self._fresh(rng)
            self._taken, self._source = 0, rng
        fresh, rows = self._prepared, slice(self._taken, self._taken + len(envs))
        self._taken = rows.stop

        def put(values: np.ndarray, new: np.ndarray) -> np.ndarray:
            values = values.copy()  # it belongs to an earlier state or to the result of this step, too
            values[envs] = new[rows]
            return values

        physics = state.physics.copy()  # what the task returned may be a view of it
        physics[envs] = _physics(fresh, self.task.model.na)[rows]
        # These arrays were made for this state alone.
        state.is_first[envs], state.episode_step[envs], state.episode_return[envs] = True, 0, 0.0
        self._write_fields(envs, fresh.model_fields, rows)
        return state._replace(
            physics=physics,
            task=type(state.task)(*map(put, state.task, fresh.state)),
            model_fields={name: put(values, fresh.model_fields[name]) for name, values in state.model_fields.items()},
            observation=put(state.observation, fresh.observation),
        )

    def _write_fields(self, envs: np.ndarray | slice, fields: dict[str, np.ndarray], rows: Any) -> None:
        """Rows `rows` of the randomised fields into those of the environments `envs`."""
        for name, values in fields.items():
            self._field(name)[envs] = values[rows]

    def _field(self, name: str) -> np.ndarray:
        """Field `name` of the model, [E, ...], with a value of its own in each environment from now on."""
        if name not in self._fields:
            self._fields[name] = self._batch.expand("opt.timestep" if name == "timestep" else name)
        return self._fields[name]


def _physics(fresh: Reset, activations: int) -> np.ndarray:
    """The physics state of fresh episodes, [E, nstate]: time, qpos, qvel, and what lags in actuators at rest."""
    *shape, _ = fresh.qpos.shape
    return np.concatenate([np.zeros((*shape, 1)), fresh.qpos, fresh.qvel, np.zeros((*shape, activations))], axis=-1)
