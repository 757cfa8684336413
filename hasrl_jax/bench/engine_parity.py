"""How far C MuJoCo and MJX drift apart from the same states, actions and draws.

States come from C simulations under random actions. Both engines then take the same actions; an environment is compared
up to the step where either engine ends its episode, because what follows belongs to another episode. Under random
actions Cassie falls within a second, so at long horizons most environments are compared at their end.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from hasrl_jax.config.schema import Config
from hasrl_jax.envs.cpu_engine import CpuEnvs, EnvState, StepResult
from hasrl_jax.envs.mjx_engine import MjxEngine, MjxEnvState, make_engine
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task

HORIZONS = (1, 10, 40)  # environment steps
WARM_UP = 20  # environment steps under random actions, at most, before the comparison
ACTION_SCALE = 0.3  # standard deviation of the random actions
SMALLEST_SPREAD = 1e-2  # standard deviation of an observation, at least, as in the learner's statistics
NEVER = 2**31 - 1  # no time limit


class Recording(NamedTuple):
    """One engine's outcome of S environment steps of N environments."""

    observation: np.ndarray  # [S, N, O]
    reward_terms: np.ndarray  # [S, N, R]
    measures: np.ndarray  # [S, N, M]
    terminated: np.ndarray  # [S, N] bool
    diverged: np.ndarray  # [S, N] bool
    loop_error: np.ndarray  # [S, N] largest gap of the closed loops, m


class _GivenDraws:
    """Takes the place of a NumPy generator: answers with the numbers of the current environment step."""

    def __init__(self, shape: tuple[int, int]):
        self.uniforms = np.zeros(shape)

    def random(self, shape: tuple[int, int]) -> np.ndarray:
        # Only a reset asks for another shape; it begins an episode that is not compared.
        return self.uniforms if shape == self.uniforms.shape else np.full(shape, 0.5)


def measure(
    config: Config,
    num_states: int = 64,
    horizons: tuple[int, ...] = HORIZONS,
    seed: int = 0,
    impl: str = "jax",
    double_precision: bool = False,
) -> dict[str, Any]:
    """Runs both engines and compares them.

    Args:
      config: reads the task and `physics`.
      num_states: N, random states, each with random actions of its own.
      horizons: numbers of environment steps after which to report.
      seed: of states, actions and draws.
      impl: "jax" or "warp".
      double_precision: runs MJX in float64, which tells a different model from rounding.

    Returns:
      {"settings": {...}, "horizons": {steps: {quantity: {"max", "mean"}, ...}}}, ready for JSON. For every horizon:
      `observation` and every reward term (absolute differences after that many environment steps, or in the last step
      of an episode that ended before), `observation_relative` and `measures_relative` (to the standard deviation of
      each element over the environments), `loop_error_difference_m`, `loop_error_c_m`, `loop_error_mjx_m` (likewise,
      but one step earlier where an episode ended), `still_running` (share of environments that neither engine ended
      before the horizon) and `termination_agreement` (share that both engines ended at the same step, or not at all).
    """
    task = make_task(config)
    rng = np.random.default_rng(seed)
    start = random_states(task, num_states, rng)
    steps = max(horizons)
    actions = ACTION_SCALE * rng.standard_normal((steps, num_states, task.action_size))
    uniforms = rng.random((steps, num_states, task.step_uniforms))
    with jax.enable_x64(double_precision):
        ours = run_mjx(make_engine(task, impl, NEVER, num_states, warp_on_cpu=True), start, actions, uniforms)
    reference = run_c(task, start, actions, uniforms)
    settings = {
        "task": task.name,
        "states": num_states,
        "seed": seed,
        "impl": impl,
        "precision": "float64" if double_precision else "float32",
        "timestep_s": config.physics.timestep_s,
        "steps_per_env_step": task.steps_per_env_step,
    }
    return {"settings": settings, "horizons": {str(n): compare(task, reference, ours, n) for n in horizons}}


def random_states(task: Task, num_states: int, rng: np.random.Generator) -> EnvState:
    """States that C simulations reach under random actions, each after a random number of environment steps."""
    envs = CpuEnvs(task, num_states, NEVER)
    state = envs.reset(rng)
    chosen = state
    stop = rng.integers(0, WARM_UP + 1, num_states)
    for step in range(1, WARM_UP + 1):
        state, _ = envs.step(state, ACTION_SCALE * rng.standard_normal((num_states, task.action_size)), rng)
        chosen = jax.tree.map(partial(_take, stop == step), state, chosen)
    return chosen


def _take(pick: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """`new` in the rows where `pick`, else `old`."""
    return np.where(pick.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def run_c(task: Task, start: EnvState, actions: np.ndarray, uniforms: np.ndarray) -> Recording:
    """C MuJoCo from `start` under actions [S, N, A] with the task's uniform numbers [S, N, step_uniforms]."""
    num_envs = actions.shape[1]
    envs = CpuEnvs(task, num_envs, NEVER)
    envs.restore(start)
    draws = _GivenDraws(uniforms.shape[1:])
    state, rows = start, []
    for action, draws.uniforms in zip(actions, uniforms, strict=True):
        state, result = envs.step(state, action, draws)  # type: ignore[arg-type]
        gap = loop_errors(task.model, state.physics[:, 1 : 1 + task.model.nq])
        rows.append(_row(result, gap))
    return Recording(*map(np.stack, zip(*rows, strict=True)))


def run_mjx(engine: MjxEngine, start: EnvState, actions: np.ndarray, uniforms: np.ndarray) -> Recording:
    """MJX from `start`; arguments as in `run_c`."""
    state = from_c(engine.task, start)
    advance = jax.jit(jax.vmap(engine.advance))
    rows = []
    for action, draw in zip(actions, uniforms, strict=True):
        state, result = advance(state, jnp.asarray(action), jnp.asarray(draw))
        gap = loop_errors(engine.task.model, np.asarray(state.qpos, np.float64))
        rows.append(_row(result, gap))
    return Recording(*(np.stack([np.asarray(x) for x in column]) for column in zip(*rows, strict=True)))


def _row(result: StepResult, loop_error: np.ndarray) -> Recording:
    """One environment step of all environments."""
    outcome = result.final_observation, result.reward_terms, result.measures, result.terminated, result.diverged
    return Recording(*outcome, loop_error)


def from_c(task: Task, state: EnvState) -> MjxEnvState:
    """The C engine's state of N environments as MJX takes it, in the default precision."""
    nq, num_envs = task.model.nq, len(state.episode_step)

    def convert(array: np.ndarray) -> jax.Array:
        return jnp.asarray(array, jnp.result_type(float))

    return MjxEnvState(
        key=jnp.zeros((num_envs, 2), jnp.uint32),
        qpos=convert(state.physics[:, 1 : 1 + nq]),
        qvel=convert(state.physics[:, 1 + nq : 1 + nq + task.model.nv]),
        task=jax.tree.map(convert, state.task),
        model_fields=jax.tree.map(convert, state.model_fields),
        observation=convert(state.observation),
        is_first=jnp.asarray(state.is_first),
        episode_step=jnp.asarray(state.episode_step, jnp.int32),
        episode_return=convert(state.episode_return),
        overflow=jnp.zeros((num_envs, 2), bool),
    )


def loop_errors(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Largest distance between the two anchors of a `connect` constraint, m: [N, nq] -> [N]; 0 without any."""
    connects = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT)
    data = mujoco.MjData(model)
    errors = np.zeros(len(qpos))
    for row, position in enumerate(qpos):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        for equality in connects:
            bodies, anchors = (model.eq_obj1id[equality], model.eq_obj2id[equality]), model.eq_data[equality, :6]
            ends = [
                data.xpos[b] + data.xmat[b].reshape(3, 3) @ a
                for b, a in zip(bodies, anchors.reshape(2, 3), strict=True)
            ]
            errors[row] = max(errors[row], np.linalg.norm(ends[0] - ends[1]))
    return errors


def compare(task: Task, reference: Recording, ours: Recording, steps: int) -> dict[str, Any]:
    """The differences after `steps` environment steps; see `measure`."""

    def summary(values: np.ndarray) -> dict[str, float]:
        return {"max": float(values.max()), "mean": float(values.mean())} if values.size else {"max": 0.0, "mean": 0.0}

    ends = first_end(reference, steps), first_end(ours, steps)
    end = np.minimum(*ends)
    envs = np.arange(len(end))
    diverged = reference.diverged[:steps].any(axis=0) | ours.diverged[:steps].any(axis=0)
    last = np.minimum(end, steps - 1)[~diverged], envs[~diverged]
    # After an episode's last step the simulation already holds the next one, so its loops are looked at before.
    whole = ~diverged & (end > 0)
    closed = np.minimum(end, steps)[whole] - 1, envs[whole]

    difference = np.abs(reference.observation[last] - ours.observation[last])
    measures = np.abs(reference.measures[last] - ours.measures[last])
    terms = np.abs(reference.reward_terms[last] - ours.reward_terms[last])
    result: dict[str, Any] = {
        "observation": summary(difference),
        "observation_relative": summary(difference / _spread(reference.observation[last])),
        "measures_relative": summary(measures / _spread(reference.measures[last])),
        **{name: summary(terms[:, i]) for i, name in enumerate(task.reward_terms)},
        "loop_error_difference_m": summary(np.abs(reference.loop_error[closed] - ours.loop_error[closed])),
        "loop_error_c_m": summary(reference.loop_error[closed]),
        "loop_error_mjx_m": summary(ours.loop_error[closed]),
        "still_running": float((end >= steps - 1).mean()),
        "termination_agreement": float((ends[0] == ends[1]).mean()),
    }
    return result


def _spread(values: np.ndarray) -> np.ndarray | float:
    """The standard deviation of each element over the environments, [N, K] -> [K]; SMALLEST_SPREAD at least."""
    return np.maximum(values.std(axis=0), SMALLEST_SPREAD) if values.size else 1.0


def first_end(recording: Recording, steps: int) -> np.ndarray:
    """The index of each environment's first ended step, `steps` without one: [N]."""
    ended = (recording.terminated | recording.diverged)[:steps]
    return np.where(ended.any(axis=0), ended.argmax(axis=0), steps)


def to_markdown(report: dict[str, Any]) -> str:
    """The report of `measure` as a table: one row per quantity, largest and mean difference per horizon."""
    settings, horizons = report["settings"], report["horizons"]
    caption = (
        "{task}, {states} states, MJX {impl} in {precision}, {steps_per_env_step} physics steps of {timestep_s:g} s"
    )
    lines = [
        caption.format(**settings) + " per environment step; largest (mean) absolute difference",
        "",
        "| quantity | " + " | ".join(f"{n} environment step{'s' if n != '1' else ''}" for n in horizons) + " |",
        "|---" * (1 + len(horizons)) + "|",
    ]
    for name, value in next(iter(horizons.values())).items():
        if isinstance(value, dict):
            cells = [f"{h[name]['max']:.1e} ({h[name]['mean']:.1e})" for h in horizons.values()]
        else:
            cells = [f"{h[name]:.1%}" for h in horizons.values()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
