"""Loads the parameters that a policy acts with, from a run directory or from a released policy file."""

import dataclasses
import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from hasrl_jax.config import curriculum, tasks
from hasrl_jax.config.checks import check
from hasrl_jax.config.compat import upgraded
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.config.schema import Config
from hasrl_jax.envs import layout
from hasrl_jax.envs.layout import Entry
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import CheckpointError, ConfigError
from hasrl_jax.learn import normalize, ppo
from hasrl_jax.policy.numpy_networks import parameter_shapes
from hasrl_jax.runs import checkpoint
from hasrl_jax.runs.directory import CHECKPOINTS_DIRECTORY, load_run_config

_FOLDER = Path(__file__).parent / "released"
RELEASED = {
    "released": _FOLDER / "cassie_walk.npz",
    "released-steer": _FOLDER / "cassie_steer.npz",
    "released-fast": _FOLDER / "cassie_fast.npz",
    "released-stairs": _FOLDER / "cassie_stairs.npz",
    "released-imitate": _FOLDER / "cassie_imitate.npz",
    "released-gaits": _FOLDER / "cassie_gaits.npz",
}
EXPECTED = f"a policy file, or one of {', '.join(RELEASED)}"
# Of the files; a digest inside a file finds damage, and this one a file that was put in its place.
RELEASED_SHA256 = {
    "released": "a848c5a08b333bcc5d869a874a3b3bdbe69af6a580e4a3739e6c992f393d575f",
    "released-steer": "46a840064f5ea73b65d25d8d87e1267deb120e56ca8efa43a0d11f97af03a8a8",
    "released-fast": "fa793bf329a7969197ccc8d0ec9c56dd131208adef00b21cec31acc281d43722",
    "released-stairs": "926daae42a0574c42803f9fd5b3fd5cdc8622f4b7cace6329c088de929903590",
    "released-imitate": "404d32723b025372d7d04b97b978f70472b63510093d9747041f9dcd8ec9c68c",
    "released-gaits": "09201d2dfbecca2bda5ed923f3856cdaf927bc5293dfb2598be4cf51a19a1bc7",
}


def load_policy_parameters(
    run_dir: str | Path | None, policy: str | Path | None
) -> tuple[Config, dict[str, np.ndarray]]:
    """The configuration a policy was trained with last, and its parameters as `ppo.export_parameters` names them.

    Args:
      run_dir: a run directory, whose newest whole checkpoint is taken; or None.
      policy: a file of `checkpoint.save_policy` with its configuration under `config`, or one of `RELEASED`, the
        policies that come with the package; None for both gives "released".

    Raises:
      ConfigError: both are given.
      RunError, CheckpointError: what is named is missing, damaged or of another network.
    """
    if run_dir is not None and policy is not None:
        raise ConfigError("--run-dir and --policy: give only one of them")
    if run_dir is not None:
        return _from_run(Path(run_dir))
    source = policy or "released"
    path = RELEASED.get(str(source), Path(source))
    if str(source) in RELEASED_SHA256:
        _require_released(path, RELEASED_SHA256[str(source)])
    return _from_file(path)


def load_baseline(name: str, like: Config) -> tuple[Config, dict[str, np.ndarray]]:
    """A policy to compare with: "zero" (the neutral pose for ever), "random" (untrained), a run directory or a file.

    Args:
      name: which.
      like: the configuration whose task and network "zero" and "random" take.

    Raises:
      RunError, CheckpointError: as `load_policy_parameters`.
    """
    if name not in ("zero", "random"):
        return _from_source(name)
    task = make_task(like)
    learner = ppo.init_learner(like, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    parameters = ppo.export_parameters(learner, like.network.normalize_observations)
    factor = 0.0 if name == "zero" else 1.0  # without weights and biases the mean action is zero
    keep = ("policy/log_std", "normalizer/mean", "normalizer/std")
    return like, {key: array if key in keep else factor * array for key, array in parameters.items()}


def under_reference_physics(config: Config) -> Config:
    """`config` with the physics that a policy of its task is judged under, see `TaskSpec.reference_physics`."""
    physics = tasks.find(config.task).reference_physics
    return config if physics is None else dataclasses.replace(config, physics=physics())


def load_initial(config: Config, source: str) -> dict[str, np.ndarray]:
    """The parameters that a run of `config` starts from, its exploration included.

    Args:
      source: a policy file, one of `RELEASED`, or a run directory.

    Raises:
      ConfigError: another task or network than the run's; RunError, CheckpointError: as `load_policy_parameters`.
    """
    trained, parameters = _from_source(source)
    if tasks.find(trained.task).name != tasks.find(config.task).name:  # a task that was extended keeps its name
        raise ConfigError(f"--init-policy {source}: a policy for task {trained.task}; this run's is {config.task}")
    for name in ("memory", "hidden_size", "symmetric", "normalize_observations"):
        its, ours = getattr(trained.network, name), getattr(config.network, name)
        if its != ours:
            raise ConfigError(f"network.{name}: got {ours}; --init-policy {source} needs --network.{name} {its}")
    its_task, our_task = make_task(trained), make_task(config)
    parameters = _for_observation(parameters, its_task.observation, our_task.observation, source)
    return _for_action(parameters, its_task.action, our_task.action)


def _for_observation(
    parameters: dict[str, np.ndarray], its: tuple[Entry, ...], ours: tuple[Entry, ...], source: str
) -> dict[str, np.ndarray]:
    """`parameters` of a policy that sees `its` quantities, for one that sees `ours`: those that are new have no effect.

    Raises:
      ConfigError: it sees a quantity that we do not.
    """
    if its == ours:
        return parameters
    known, wanted = layout.places(its), {entry.name: entry for entry in ours}
    for entry in its:
        if entry.name not in wanted or wanted[entry.name].size != entry.size:
            raise ConfigError(
                f"--init-policy {source}: it sees {entry.name} ({entry.size}); this run's policies do not"
            )

    def rows(array: np.ndarray, fill: str | None) -> np.ndarray:
        """`array` [O of its, ...] as [O of ours, ...]; new rows hold an attribute of their entry, or zeros."""
        parts = [
            array[known[entry.name]]
            if entry.name in known
            else np.full((entry.size, *array.shape[1:]), getattr(entry, fill) if fill else 0.0, array.dtype)
            for entry in ours
        ]
        return np.concatenate(parts)

    fills = {
        "policy/lstm_0_input": None,
        "policy/dense_0_kernel": None,
        "value/dense_0_kernel": None,
        "normalizer/mean": "mean",
        "normalizer/std": "std",
    }
    changed = {name: rows(parameters[name], fill) for name, fill in fills.items() if name in parameters}
    return parameters | changed


def _for_action(
    parameters: dict[str, np.ndarray], its: tuple[Entry, ...], ours: tuple[Entry, ...]
) -> dict[str, np.ndarray]:
    """`parameters` of a policy whose actions stand for `its` quantities, for one whose actions stand for `ours`.

    Where an action of 1 stands for r times as much, the head's output z becomes z / r: r tanh(z / r) has the slope of
    tanh(z) at 0, and goes further where that was near its bound. The exploration stays the same in the unit.
    """
    its_scale, our_scale = (np.repeat([e.scale for e in table], [e.size for e in table]) for table in (its, ours))
    ratio = (its_scale / our_scale).astype(np.float32)
    if (ratio == 1).all():
        return parameters
    return parameters | {
        "policy/mean_kernel": parameters["policy/mean_kernel"] * ratio,
        "policy/mean_bias": parameters["policy/mean_bias"] * ratio,
        "policy/log_std": parameters["policy/log_std"] + np.log(ratio),
    }


def with_parameters(learner: ppo.LearnerState, parameters: dict[str, np.ndarray]) -> ppo.LearnerState:
    """`learner` before its first iteration, with what `ppo.export_parameters` returned in place of its own parameters.

    The optimisers stay fresh.
    """

    def group(name: str) -> dict[str, jax.Array]:
        return {key.removeprefix(name): jnp.array(x) for key, x in parameters.items() if key.startswith(name)}

    statistics, normalizer = group("normalizer/"), learner.normalizer
    if statistics:
        normalizer = normalize.from_mean_std(statistics["mean"], statistics["std"])
    return learner._replace(policy_params=group("policy/"), value_params=group("value/"), normalizer=normalizer)


def training_digest_of(policy: str | Path | None) -> str | None:
    """What a policy file says of the training that it came from (`training_sha256`); None where nothing does.

    Args:
      policy: as in `load_policy_parameters`.

    Raises:
      CheckpointError: the file is missing or damaged.
    """
    if policy is None:
        return None
    _, metadata = checkpoint.load_policy(RELEASED.get(str(policy), Path(policy)), EXPECTED)
    found = metadata.get("training_sha256")
    return found if isinstance(found, str) else None


def policy_metadata(config: Config) -> dict[str, object]:
    """What a released policy file must carry besides its parameters."""
    return {"config": to_dict(config)}


def _from_source(source: str) -> tuple[Config, dict[str, np.ndarray]]:
    """`load_policy_parameters` of a run directory, a file, or one of `RELEASED`."""
    return load_policy_parameters(*((source, None) if Path(source).is_dir() else (None, source)))


def _from_run(run_dir: Path) -> tuple[Config, dict[str, np.ndarray]]:
    config = load_run_config(run_dir)
    task = make_task(config)
    template = ppo.init_learner(config, task.observation_size, task.action_size, task.mirror, jax.random.key(0))
    loaded = checkpoint.load(run_dir / CHECKPOINTS_DIRECTORY, template)
    config = curriculum.in_force(config, curriculum.begun(config, loaded.extra))
    return config, ppo.export_parameters(loaded.learner, config.network.normalize_observations)


def _require_released(path: Path, expected: str) -> None:
    """Refuses a file that is not the one that was released.

    Raises:
      CheckpointError: it is another, or cannot be read.
    """
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from None
    if found != expected:
        raise CheckpointError(
            f"{path}: not the policy of this release: its SHA-256 is {found[:12]}…, expected {expected[:12]}…; install "
            "the package again, or name the file itself to play it"
        )


def _from_file(path: Path) -> tuple[Config, dict[str, np.ndarray]]:
    parameters, metadata = checkpoint.load_policy(path, EXPECTED)
    try:
        config = from_dict(upgraded(metadata["config"]))
        check(config)
    except (KeyError, TypeError, ConfigError) as error:
        raise CheckpointError(f"{path}: its configuration cannot be read: {error}") from None
    task = make_task(config)
    wanted = parameter_shapes(task.observation_size, task.action_size, config.network)
    for name, shape in wanted.items():
        found = parameters[name].shape if name in parameters else "missing"
        if found != shape:
            raise CheckpointError(f"{path}: parameter {name} is {found}; its configuration asks for {shape}")
        if parameters[name].dtype != np.float32:
            raise CheckpointError(f"{path}: parameter {name} is of type {parameters[name].dtype}; expected float32")
        if not np.isfinite(parameters[name]).all():
            raise CheckpointError(f"{path}: parameter {name} holds numbers that are not finite")
    if (parameters.get("normalizer/std", np.ones(1)) <= 0).any():
        raise CheckpointError(f"{path}: parameter normalizer/std holds numbers that are not positive")
    return config, {name: parameters[name] for name in wanted}
