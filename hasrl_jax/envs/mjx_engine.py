"""One environment on MuJoCo's JAX port: pure functions, to be vmapped; the engine behind the MJX mode.

The counterpart of `cpu_engine` for accelerators. Shapes are those of a single environment. A reset needs no physics, so
every step prepares a fresh episode and takes it where the last one ended: each episode has draws of its own.
"""

import importlib.util
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from hasrl_jax.envs import motors
from hasrl_jax.envs.cpu_engine import StepResult
from hasrl_jax.envs.mjx_physics import Loops, find_loops, mjx, physics_step
from hasrl_jax.envs.task import Reading, Task
from hasrl_jax.errors import ConfigError
from hasrl_jax.types import Array

LARGEST = mujoco.mjMAXVAL  # C MuJoCo, too, gives up a simulation that holds a larger number
# Bits of the overflow word of MuJoCo Warp: broad phase, narrow phase and collision detection; constraint rows and
# their non-zeros. The other bits do not concern limits that can be configured.
CONTACT_BITS, CONSTRAINT_BITS = 4 | 8 | 16, 1 | 2


class MjxEnvState(NamedTuple):
    """The complete state of one environment; plain arrays, so that a checkpoint is a copy of them."""

    key: Array  # [2] uint32, the environment's own random stream
    qpos: Array  # [nq]
    qvel: Array  # [nv]
    task: Any  # the task's NamedTuple
    model_fields: dict[str, Array]  # randomised model fields of this episode
    observation: Array  # [O] the observation that the policy sees next
    is_first: Array  # [] bool: that observation opens an episode
    episode_step: Array  # [] int32 environment steps since reset
    episode_return: Array  # [] sum of rewards since reset
    overflow: Array  # [2] bool: the last environment step had too many contacts, constraints for Warp's limits


@dataclass(frozen=True)
class MjxEngine:
    """A task on MJX; made by `make_engine`.

    All methods are pure and describe one environment: use them under `jax.vmap`.
    """

    task: Task
    max_episode_steps: int
    model: mjx.Model  # the nominal robot
    data: mjx.Data  # blank: a physics step overwrites all that matters
    loops: Loops
    curve: motors.Curve | None  # of its motors, where the physics step has to add it

    def reset(self, key: Array) -> MjxEnvState:
        """A fresh episode. `key`: [2] uint32; the environment draws everything from it, now and later."""
        key, draw_key = jax.random.split(key)
        return self.begin(key, jax.random.uniform(draw_key, (self.task.reset_uniforms,)))

    def begin(self, key: Array, uniforms: Array) -> MjxEnvState:
        """A fresh episode from given uniform numbers [task.reset_uniforms]."""
        with jax.default_matmul_precision("highest"):
            fresh = self.task.reset(uniforms, jnp)
        return MjxEnvState(
            key=key,
            qpos=fresh.qpos,
            qvel=fresh.qvel,
            task=fresh.state,
            model_fields=fresh.model_fields,
            observation=fresh.observation,
            is_first=jnp.asarray(True),
            episode_step=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(()),
            overflow=jnp.zeros(2, bool),
        )

    def step(self, state: MjxEnvState, action: Array) -> tuple[MjxEnvState, StepResult]:
        """One environment step; an environment whose episode ended is reset with fresh draws.

        Args:
          state: as returned by `reset` or by the previous `step`.
          action: [A].

        Returns:
          The next state, always finite, and what the step produced. Where `diverged`, the result holds zeros and the
          observation before the step.
        """
        key, step_key, reset_key = jax.random.split(state.key, 3)
        uniforms = jax.random.uniform(step_key, (self.task.step_uniforms,))
        advanced, result = self.advance(state._replace(key=key), action, uniforms)
        fresh = self.begin(key, jax.random.uniform(reset_key, (self.task.reset_uniforms,)))
        fresh = fresh._replace(overflow=advanced.overflow)
        ended = result.terminated | result.truncated | result.diverged
        return _select(ended, fresh, advanced), result

    def advance(self, state: MjxEnvState, action: Array, uniforms: Array) -> tuple[MjxEnvState, StepResult]:
        """As `step`, but from given uniform numbers [task.step_uniforms] and without a reset at the end."""
        task = self.task
        with jax.default_matmul_precision("highest"):  # TF32 would cost the physics three digits
            reading, overflow = self.simulate(state, self.control(state, action))
            outcome = task.step(state.task, action, reading, uniforms, jnp)
        finite = [_all_moderate(x) for x in (*reading, outcome.observation, outcome.reward_terms, outcome.measures)]
        diverged = ~jnp.all(jnp.stack(finite))
        episode_step = state.episode_step + 1
        terminated = outcome.terminated & ~diverged
        result = StepResult(
            reward=jnp.where(diverged, 0.0, outcome.reward),
            terminated=terminated,
            truncated=(episode_step >= self.max_episode_steps) & ~terminated & ~diverged,
            diverged=diverged,
            final_observation=jnp.where(diverged, state.observation, outcome.observation),
            reward_terms=jnp.where(diverged, 0.0, outcome.reward_terms),
            measures=jnp.where(diverged, 0.0, outcome.measures),
        )
        next_state = state._replace(
            qpos=reading.qpos,
            qvel=reading.qvel,
            task=outcome.state,
            observation=outcome.observation,
            is_first=jnp.zeros((), bool),
            episode_step=episode_step,
            episode_return=state.episode_return + result.reward,
            overflow=overflow,
        )
        return next_state, result

    def control(self, state: MjxEnvState, action: Array) -> Array:
        """Controls of the physics steps of an environment step, [S, nu]."""
        task, steps = self.task, self.task.steps_per_env_step
        control = jnp.broadcast_to(task.control(state.task, action, jnp), (steps, task.model.nu))
        if task.delay is None:
            return control
        earlier, delay_s = task.delay(state.task, jnp)
        delay_steps = delay_s / self._physics_step_s(state)
        late = jnp.arange(steps) + 0.5 < delay_steps
        return jnp.where(late[:, None], task.control(state.task, earlier, jnp), control)

    def simulate(self, state: MjxEnvState, control: Array) -> tuple[Reading, Array]:
        """The physics steps of one environment step under `control` [S, nu]; also the overflow flags [2]."""
        task, fields = self.task, state.model_fields
        if task.pace:
            fields = fields | {"timestep": self._physics_step_s(state)}
        if self.curve and "actuator_gainprm" in fields:
            fields = fields | motors.pd_parameters(fields["actuator_gainprm"], jnp)
        model = _with_fields(self.model, fields)

        def advance_and_sum(carry: tuple[mjx.Data, Array], control: Array) -> tuple[tuple[mjx.Data, Array], None]:
            data, total = carry
            data = physics_step(model, data.replace(ctrl=control), self.loops, self.curve)
            return (self._keep(data), total + task.physics_features(data.sensordata, jnp)), None

        # Like the C engine, every environment step starts from a zero warm start, so its state is qpos and qvel.
        data = self.data.replace(qpos=state.qpos, qvel=state.qvel, ctrl=control[0])
        if task.force and task.disturbed:
            data = data.replace(qfrc_applied=task.force(state.task, jnp))
        total = jnp.zeros_like(task.physics_features(data.sensordata, jnp))
        (data, total), _ = jax.lax.scan(advance_and_sum, (data, total), control)
        return Reading(data.qpos, data.qvel, data.sensordata, total / task.steps_per_env_step), _overflow(data)

    def _physics_step_s(self, state: MjxEnvState) -> Array:
        """Physics step within the coming environment step, s, []."""
        timestep = state.model_fields.get("timestep", self.task.model.opt.timestep)
        return timestep if self.task.pace is None else timestep * self.task.pace(state.task, jnp)

    def _keep(self, data: mjx.Data) -> mjx.Data:
        """Only what the next physics step reads; carrying all of it costs a quarter of the time.

        Warp instead updates its own buffers in place, and wants them back.
        """
        if self.model.impl == mjx.Impl.WARP:
            return data
        names = ("qpos", "qvel", "ctrl", "qfrc_applied", "qacc_warmstart", "sensordata")
        return self.data.replace(**{name: getattr(data, name) for name in names})


def make_engine(
    task: Task,
    impl: str,
    max_episode_steps: int,
    num_envs: int = 1,
    contacts_per_env: int = 16,
    constraints_per_env: int = 64,
    warp_on_cpu: bool = False,
) -> MjxEngine:
    """Puts the task's model on the default device.

    Args:
      task: the definition to run.
      impl: "jax" for any device, "warp" for NVIDIA.
      max_episode_steps: time limit in environment steps.
      num_envs: environments stepped together on one device; they share Warp's room for contacts.
      contacts_per_env: that room divided by `num_envs`. Warp only.
      constraints_per_env: most constraint rows of one environment. Warp only.
      warp_on_cpu: lets Warp run, slowly, without an NVIDIA device; for tests.

    Raises:
      ConfigError: a setting that MJX cannot run; names what works.
    """
    if task.ground is not None:
        raise ConfigError(
            "cassie.terrain.kind: the mjx backend has level ground only; set it to flat, or use cpu_pool "
            "(MJX would compute the contacts with each box of the ground in every physics step)"
        )
    if task.model.na:
        raise ConfigError(
            f"{task.name}: the mjx backend keeps no state of actuators from one environment step to the next; set "
            "cassie.randomize.torque_lag_s to 0 0, or use cpu_pool"
        )
    if task.model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        raise ConfigError("physics.solver: MJX has no PGS; set it to Newton")
    if impl not in ("jax", "warp"):
        raise ConfigError(f"mjx.impl: got {impl!r}; expected 'jax' or 'warp'")
    if impl == "warp":
        _start_warp(warp_on_cpu)
    plain, curve = motors.without_curve(task.model) if impl == "jax" else (task.model, None)
    try:
        model = mjx.put_model(plain, impl=impl)
    except NotImplementedError as error:
        raise ConfigError(
            f"mjx.impl: {impl} cannot run the model of task {task.name} ({error}); set backend to cpu_pool"
        ) from None
    loops = find_loops(task.model)
    if impl == "jax":
        return MjxEngine(task, max_episode_steps, model, mjx.make_data(model, impl=impl), loops, curve)
    model = model.tree_replace({"opt._impl.warn_overflow": 0})  # counted here, not printed
    data = mjx.make_data(task.model, impl=impl, naconmax=num_envs * contacts_per_env, njmax=constraints_per_env)
    return MjxEngine(task, max_episode_steps, model, data, loops, curve)


def _start_warp(on_cpu: bool) -> None:
    """Checks that Warp can run, and stops its line per compiled kernel.

    Raises:
      ConfigError: it is not installed, or there is no NVIDIA device and `on_cpu` is not set.
    """
    if importlib.util.find_spec("warp") is None:
        raise ConfigError("mjx.impl: warp needs the package warp-lang; install mujoco-mjx[warp] or set mjx.impl to jax")
    device = jax.devices()[0]
    if not on_cpu and "nvidia" not in device.device_kind.lower():
        raise ConfigError(f"mjx.impl: warp needs an NVIDIA device, and JAX runs on {device}; set mjx.impl to jax")
    import warp

    warp.config.log_level = warp.LOG_WARNING


def _with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """The robot of one episode."""
    return model.tree_replace({"opt.timestep" if name == "timestep" else name: x for name, x in fields.items()})


def _overflow(data: mjx.Data) -> Array:
    """Whether Warp dropped contacts, constraints: [2] bool. The JAX implementation has room for all of them."""
    if data.impl != mjx.Impl.WARP:
        return jnp.zeros(2, bool)
    word = jnp.reshape(data._impl.overflow, ())
    return jnp.stack([(word & CONTACT_BITS) != 0, (word & CONSTRAINT_BITS) != 0])


def _all_moderate(values: Array) -> Array:
    """False when a number is NaN, infinite or absurd; [...] -> []."""
    return jnp.all(jnp.abs(values) < LARGEST)


def _select(condition: Array, yes: Any, no: Any) -> Any:
    """`yes` where the scalar `condition` holds, else `no`, in the types of `no`."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b).astype(b.dtype), yes, no)
