"""`bench compare`: this project against two usual ways to train a recurrent policy on a gymnasium environment.

    sb3           stable-baselines3-contrib: RecurrentPPO on SubprocVecEnv
    sb3_make_vec  the same on `gymnasium.make_vec`, that is on this project's engine
    torch         gymnasium's AsyncVectorEnv with a recurrent PPO of our own in torch, `compare_torch`

With --unilab, UniLab's G1 and our Cassie too, each as a share of the physics limit of its own model (`compare_unilab`).

All but that train on the same task in the same run. A short search first gives each peer its best number of
environments and threads; then rounds of ours and of the peers alternate, and medians are quoted.
"""

import argparse
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import jax

from hasrl_jax.bench import compare_unilab
from hasrl_jax.bench.collector import PHYSICS, with_physics
from hasrl_jax.bench.compare_peers import PeerProcess
from hasrl_jax.bench.physics_limit import PhysicsLimit
from hasrl_jax.bench.report import format_table
from hasrl_jax.collect.backends import make_collector
from hasrl_jax.collect.plan import make_plan
from hasrl_jax.collect.protocol import Collector, Networks
from hasrl_jax.config.checks import check
from hasrl_jax.config.files import load_yaml
from hasrl_jax.config.schema import Config, available_cores
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.learn import ppo
from hasrl_jax.learn.networks import make_networks
from hasrl_jax.train.devices import prepare_jax

# peer -> the distributions that it needs, by the module that each provides
SB3 = {"torch": "torch", "stable_baselines3": "stable-baselines3", "sb3_contrib": "sb3-contrib"}
NEEDS = {"sb3": SB3, "sb3_make_vec": SB3, "torch": {"torch": "torch"}}
IN_ONE_PROCESS = {"sb3_make_vec": (16, 32, 64)}  # peers that step all environments themselves -> numbers to try
CLEARLY = 1.1  # less is the noise of a short search
SINGLE_STEPS = 2000  # of the lone environment, per round
EQUAL = (
    "Equal: task, physics, environment steps per update, epochs, minibatches per epoch, width and depth of both "
    "networks, GAE, Adam, no observation normalisation, no mirror, no early stop by KL, processes on one thread."
)
UNEQUAL = (
    "Not equal: ours steps many environments in each process, the peers one, because their vector environments do "
    "(but `sb3_make_vec`, which steps all of them on our engine, in one process, between its inferences); "
    "our environment costs more CPU time alone than in a batch (row `single`, one process without a policy), and "
    "`torch` and `sb3` pay that. Ours has a tanh after each LSTM layer. sb3 cuts its minibatches at episodes instead "
    "of every unroll, has one optimiser for both networks and standardises advantages per minibatch. The peers "
    "compute in torch without torch.compile; the info of a step is dropped before it is sent."
)
SHARES = (
    "UniLab {version} has no Cassie, so both are held against bare mj_step of their own models, in a process per core, "
    "under controls of an untrained policy. Read it as how much each adds to its physics, not as which is faster. Not "
    "equal: its G1 has 3 physics steps per environment step and ours 10, so an equal cost per environment step weighs "
    "more on it; its networks are MLPs (512, 256, 128) and ours recurrent; it is made for an accelerator that learns "
    "and has none here; and it pins another MuJoCo."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the comparison."""
    cores = available_cores()
    parser.add_argument("--config", default="cassie_walk", metavar="FILE", help="task, sizes and update")
    parser.add_argument("--physics", choices=tuple(PHYSICS), help="2 kHz x 50, or 400 Hz x 10; default: the config's")
    parser.add_argument("--hidden-size", type=int, metavar="H", help="width of the networks; default: the config's")
    parser.add_argument("--num-workers", type=int, default=cores, metavar="N", help="sub-processes of ours")
    parser.add_argument("--peers", nargs="*", choices=tuple(NEEDS), default=list(NEEDS), help="none: ours alone")
    parser.add_argument("--num-envs", type=int, nargs="+", metavar="N", help="environments to try for the peers")
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, cores}), metavar="N", help="torch, to try")
    parser.add_argument("--rounds", type=int, default=3, help="measured rounds, after one that warms up")
    parser.add_argument("--unilab", type=Path, metavar="PYTHON", help="of a virtual environment with unilab[mujoco]")
    parser.add_argument("--unilab-envs", type=int, default=256, metavar="N", help="its environments")


def measure(arguments: argparse.Namespace) -> dict:
    """Searches the peers' best settings, then measures all in turn.

    Raises:
      ConfigError: an impossible argument, or a peer whose packages are not installed.
    """
    config = make_config(arguments)
    plan = make_plan(config)
    choices = peer_envs(arguments, config, plan.env_steps)
    require_packages(arguments.peers)
    for name, smallest in (("rounds", arguments.rounds), ("threads", min(arguments.threads))):
        if smallest < 1:
            raise ConfigError(f"--{name}: got {smallest}; expected at least 1")
    if arguments.unilab:
        compare_unilab.version_of(arguments.unilab)
    prepare_jax(config)
    searched = [
        cell
        for peer in arguments.peers
        for cell in search(peer, config, in_one_process(peer, choices, config), arguments.threads)
    ]
    finalists = [cell for peer in arguments.peers for cell in best([c for c in searched if c["name"] == peer])]
    cells = measure_rounds(config, finalists, arguments.rounds)
    return {
        "task": config.task,
        "physics_timestep_s": config.physics.timestep_s,
        "physics_steps_per_env_step": config.physics.steps_per_env_step,
        "hidden": config.network.hidden_size,
        "env_steps_per_update": plan.env_steps,
        "epochs": config.ppo.epochs,
        "minibatches": plan.rows // config.ppo.minibatch_trajectories,
        "unroll_length": plan.max_length,
        "rounds": arguments.rounds,
        "versions": {need: metadata.version(need) for peer in arguments.peers for need in NEEDS[peer].values()},
        "search": searched,
        "cells": cells,
        "ratios": [ratios(peer, cells) for peer in arguments.peers],
        "shares": beside_unilab(arguments, config, cells[0]) if arguments.unilab else [],
    }


def beside_unilab(arguments: argparse.Namespace, config: Config, ours: dict) -> list[dict]:
    """Ours and UniLab's environment steps/s as shares of the physics limit of each one's own model."""
    plan = make_plan(config)
    with PhysicsLimit(config, plan.num_workers, plan.steps_per_worker) as limit:
        bound = statistics.median(limit.round()[0] for _ in range(arguments.rounds))
    own = compare_unilab.shares(ours["collector_per_second"], ours["env_steps_per_second"], bound)
    with tempfile.TemporaryDirectory() as folder:
        theirs = compare_unilab.measure(
            arguments.unilab, Path(folder), arguments.unilab_envs, 2 * arguments.rounds, available_cores()
        )
    return [{"name": f"ours, {config.task}", "num_envs": ours["num_envs"], **own}, theirs]


def make_config(arguments: argparse.Namespace) -> Config:
    """The configuration with what the peers do not have turned off."""
    config = load_yaml(arguments.config)
    if arguments.physics:
        config = with_physics(config, arguments.physics)
    hidden_size = config.network.hidden_size if arguments.hidden_size is None else arguments.hidden_size
    network = replace(config.network, hidden_size=hidden_size, normalize_observations=False, symmetric=False)
    config = replace(
        config,
        backend="cpu_pool",
        network=replace(network, learn_std=True),
        collect=replace(config.collect, num_workers=arguments.num_workers, mode="unrolls"),
        ppo=replace(config.ppo, max_kl=0.0, advantage="gae", learning_rate_schedule="constant"),
    )
    check(config)
    return config


def peer_envs(arguments: argparse.Namespace, config: Config, env_steps: int) -> list[int]:
    """The numbers of environments to try: each must divide an update, and a minibatch, into whole sequences."""
    sequences = config.ppo.minibatch_trajectories, env_steps // config.collect.unroll_length
    asked = arguments.num_envs or sorted({arguments.num_workers, 4, 8, 16, 32})
    choices = [number for number in asked if number > 0 and not any(count % number for count in sequences)]
    if arguments.num_envs and choices != asked:
        refused = next(number for number in asked if number not in choices)
        raise ConfigError(f"--num-envs: got {refused}; expected a divisor of {sequences[0]} and {sequences[1]}")
    return choices or [1]


def in_one_process(peer: str, choices: list[int], config: Config) -> list[int]:
    """`choices`, or for a peer that steps all environments in one process those of its own that divide a minibatch."""
    own = [number for number in IN_ONE_PROCESS.get(peer, ()) if config.ppo.minibatch_trajectories % number == 0]
    return own or choices


def require_packages(peers: list[str], option: str = "--peers") -> None:
    """Raises a ConfigError that names what is not installed, and the `option` that asks for it."""
    needs = {module: name for peer in peers for module, name in NEEDS[peer].items()}
    missing = [name for module, name in needs.items() if importlib.util.find_spec(module) is None]
    if missing:
        remedy = 'install the extra, pip install -e ".[compare]", or leave them out'
        raise ConfigError(f"{option}: {', '.join(missing)} not installed; {remedy}")


def search(peer: str, config: Config, choices: list[int], threads: list[int]) -> list[dict]:
    """Iterations of one minibatch with every number of environments and threads, each after a warm-up."""
    env_steps = config.ppo.minibatch_trajectories * config.collect.unroll_length
    cells = []
    for num_envs in choices:
        with PeerProcess(peer, config, num_envs, env_steps) as process:
            process.iterate(threads[0])
            for number in threads:
                timing = process.iterate(number)
                cells.append({"name": peer, "num_envs": num_envs, "threads": number} | speeds(env_steps, *timing))
    return cells


def best(cells: list[dict]) -> list[dict]:
    """The fastest end to end; also the fastest collector, where that is another one and clearly faster at it."""
    first = max(cells, key=lambda cell: cell["env_steps_per_second"])
    second = max(cells, key=lambda cell: cell["collector_per_second"])
    return [first, second] if second["collector_per_second"] > CLEARLY * first["collector_per_second"] else [first]


def speeds(env_steps: int, collect_seconds: float, seconds: float) -> dict[str, float]:
    """Environment steps per second, end to end and of collecting alone."""
    return {
        "env_steps_per_second": env_steps / seconds,
        "collector_per_second": env_steps / collect_seconds,
        "collect_seconds": collect_seconds,
        "learn_seconds": seconds - collect_seconds,
    }


def measure_rounds(config: Config, finalists: list[dict], rounds: int) -> list[dict]:
    """Ours, a lone environment and the finalists in turn; medians over the rounds after the first."""
    task, mesh = make_task(config), ppo.make_mesh()
    networks = make_networks(config.network, task.observation_size, task.action_size, task.mirror)
    collector = make_collector(config, task, mesh, Networks(*networks))
    plan = make_plan(config)
    with ExitStack() as stack:
        stack.enter_context(collector)
        iterate, parameters = ours(config, collector)
        single = stack.enter_context(PeerProcess("single", config, 1, SINGLE_STEPS))
        contestants = [("ours", plan.num_workers * plan.envs_per_worker, plan.num_workers, 0, parameters, iterate)]
        contestants.append(("single", 1, 1, 0, 0, lambda: speeds(SINGLE_STEPS, *single.iterate(1))))
        for cell in finalists:
            num_envs, threads = cell["num_envs"], cell["threads"]
            peer = stack.enter_context(PeerProcess(cell["name"], config, num_envs, plan.env_steps))

            def peer_iterate(peer: PeerProcess = peer, threads: int = threads) -> dict[str, float]:
                return speeds(plan.env_steps, *peer.iterate(threads))

            processes = 1 if cell["name"] in IN_ONE_PROCESS else num_envs
            contestants.append((cell["name"], num_envs, processes, threads, peer.parameters, peer_iterate))
        measured = [[contestant[-1]() for contestant in contestants] for _ in range(rounds + 1)]
    labels = ("name", "num_envs", "processes", "threads", "parameters")
    cells = []
    for contestant, figures in zip(contestants, zip(*measured[1:], strict=True), strict=True):
        medians = {name: statistics.median(figure[name] for figure in figures) for name in figures[0]}
        cells.append(dict(zip(labels, contestant, strict=False)) | medians | {"rounds": list(figures)})
    return cells


def ours(config: Config, collector: Collector) -> tuple[Callable[[], dict[str, float]], int]:
    """(one iteration as `train` runs it in the sync schedule, number of parameters)."""
    task, mesh = make_task(config), ppo.make_mesh()
    sizes = task.observation_size, task.action_size, task.mirror
    learner = ppo.init_learner(config, *sizes, jax.random.key(config.seed))
    update = ppo.make_update(config, *sizes, mesh)
    iteration = 0

    def iterate() -> dict[str, float]:
        nonlocal learner, iteration
        started = time.perf_counter()
        parameters = ppo.acting_parameters(learner, config.network.normalize_observations)
        collector.start(parameters, iteration, version=iteration)
        experience = collector.finish()
        collected = time.perf_counter()
        learner, metrics = update(learner, experience.trajectory)
        jax.block_until_ready((learner, metrics))
        iteration += 1
        return speeds(experience.env_steps, collected - started, time.perf_counter() - started)

    return iterate, sum(leaf.size for leaf in jax.tree.leaves((learner.policy_params, learner.value_params)))


def ratios(peer: str, cells: list[dict]) -> dict:
    """Ours over the peer, each at the peer's best."""
    mine = next(cell for cell in cells if cell["name"] == "ours")
    theirs = [cell for cell in cells if cell["name"] == peer]
    names = "env_steps_per_second", "collector_per_second"
    end_to_end, collecting = (mine[name] / max(cell[name] for cell in theirs) for name in names)
    return {"peer": peer, "end_to_end": end_to_end, "collector": collecting}


def tables(figures: dict) -> str:
    """Speeds, ratios, and what is and is not equal."""
    headers = ["system", "envs", "processes", "torch threads", "parameters", "env steps/s", "collector alone"]
    rows = [
        [
            cell["name"],
            cell["num_envs"],
            cell["processes"],
            cell["threads"] or "-",
            cell["parameters"] or "-",
            cell["env_steps_per_second"] if cell["name"] != "single" else "-",
            cell["collector_per_second"],
            cell["collect_seconds"] if cell["name"] != "single" else "-",
            cell["learn_seconds"] if cell["name"] != "single" else "-",
        ]
        for cell in figures["cells"]
    ]
    speed = format_table([*headers, "collect s", "learn s"], rows)
    compared = [[f"ours / {ratio['peer']}", ratio["end_to_end"], ratio["collector"]] for ratio in figures["ratios"]]
    tried = [
        [cell["name"], cell["num_envs"], cell["threads"], cell["env_steps_per_second"], cell["collector_per_second"]]
        for cell in figures["search"]
    ]
    parts = [
        f"{figures['task']} at {1 / figures['physics_timestep_s']:,.0f} Hz, hidden {figures['hidden']}, "
        f"{figures['env_steps_per_update']} environment steps per update, {figures['epochs']} epochs of "
        f"{figures['minibatches']} minibatches, medians of {figures['rounds']} rounds",
        speed,
    ]
    if compared:
        parts.append(format_table(["ratio", "end to end", "collector alone"], compared))
        parts.append(format_table(["tried", "envs", "threads", "env steps/s", "collector alone"], tried))
        versions = ", ".join(f"{name} {version}" for name, version in figures["versions"].items())
        parts += [EQUAL, UNEQUAL, versions]
    if figures["shares"]:
        headers = ["share of its own limit", "envs", "limit", "collecting", "share", "end to end", "share"]
        names = ["name", "num_envs", "limit_env_steps_per_second", "collector_per_second", "collecting_share"]
        names += ["env_steps_per_second", "end_to_end_share"]
        rows = [[cell[name] for name in names] for cell in figures["shares"]]
        parts += [format_table(headers, rows), SHARES.format(version=figures["shares"][1]["version"])]
    return "\n\n".join(parts)
