"""Changes lines of the mathematics one by one and runs the tests that are for them: `make mutation`.

Every change is printed, with whether a test noticed it; docs/mutation.md says why those that are left are left. Works
on a copy, in a process of its own for each change. Arguments: names of modules as below; none stands for all of them,
and `learn/returns:24` leaves out the first 24 changes, for a run that goes on where another ended.
"""

import compileall
import difflib
import importlib
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

from cosmic_ray import plugins
from cosmic_ray.mutating import mutate_code

ROOT = Path(__file__).parents[1]
PROPERTIES = "tests/test_properties.py"
PPO, ORACLE = "tests/learn/test_ppo.py", "tests/learn/test_ppo_oracle.py"
# The tests of each module, those first that fail soonest, and pytest's -k.
MODULES = {
    "learn/returns": (["tests/learn/test_returns.py", PROPERTIES], "not minibatches"),
    "learn/batching": (["tests/learn/test_batching.py", PROPERTIES], "minibatch"),
    "learn/distributions": (["tests/learn/test_distributions.py"], ""),
    "learn/losses": (
        [f"{PPO}::test_the_clipped_surrogate_by_hand", ORACLE, PPO],
        "hand or oracle or fresh_data or stale or lag or gradients or mask_padding",
    ),
    "learn/ppo": ([ORACLE, PPO], ""),
    "collect/buffer": (["tests/learn/test_batching.py", PROPERTIES], "pad or slots"),
    "envs/layout": (["tests/envs/test_layout.py", PROPERTIES], "layout or mirror"),
    "envs/cassie/clock": (
        ["tests/envs/test_clock.py", PROPERTIES, "tests/envs/test_heading_frame.py"],
        "clock or both_feet",
    ),
    "evaluate/statistics": (["tests/evaluate/test_statistics.py"], ""),
}
# One change of each kind where the tool would make ten: + to -, < to <=, a number to its neighbours, a negation away.
# Without changes of |, which stands in types.
OPERATORS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul|Mod_Mul|FloorDiv_Mul|BitAnd_BitOr)"
    r"|ReplaceComparisonOperator_(Gt_GtE|GtE_Gt|Lt_LtE|LtE_Lt|Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is|In_NotIn)"
    r"|ReplaceUnaryOperator_Delete_\w+|(?!Replace(Binary|Comparison|Unary)Operator)\w+)"
)
CPU_LIMIT_S = 600  # of CPU time: other work on the machine must not pass for a change that was noticed
# Loaded once, for all processes; nothing of the package itself, of which each process loads its own version.
LOADED = (
    "flax.linen",
    "gymnasium",
    "hypothesis",
    "jax.numpy",
    "mujoco.rollout",
    "optax",
    "pytest",
    "scipy.interpolate",
)


def changes(source: str) -> Iterator[tuple[str, str]]:
    """(what was changed, the source with it), one after the other."""
    for name in filter(OPERATORS.fullmatch, plugins.operator_names()):
        operator_class = plugins.get_operator(name)
        if operator_class.arguments():
            continue
        for occurrence in range(10**6):
            changed = mutate_code(source, operator_class(), occurrence)
            if changed is None:
                break
            lines = list(difflib.unified_diff(source.splitlines(), changed.splitlines(), n=0, lineterm=""))[2:]
            number = lines[0].split()[1].lstrip("-").partition(",")[0]
            yield f"{number}: " + " ".join(line for line in lines if line[0] in "-+"), changed


def passes(copy: Path, tests: list[str], chosen: str, write: bool = False) -> bool:
    """Whether the tests pass in the copy; `write` keeps what Python compiles there."""
    process = os.fork()
    if not process:
        status = 1
        try:
            os.chdir(copy)
            os.setpgid(0, 0)
            signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT_S)
            sys.dont_write_bytecode = not write
            sys.path.insert(0, str(copy))
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (1, 2):
                os.dup2(null, stream)
            import pytest

            options = ["-x", "-q", "-p", "no:cacheprovider", *tests]
            status = int(pytest.main([*options, "-k", chosen] if chosen else options))
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitpid(process, 0)[1] == 0


def run(module: str, first: int) -> None:
    """Prints how many changes of a module from number `first` on were noticed, and those that were not."""
    tracked = subprocess.run(("git", "ls-files"), cwd=ROOT, capture_output=True, text=True, check=True).stdout
    tests, chosen = MODULES[module]
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory)
        for name in tracked.splitlines():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, copy / name)
        path = copy / "hasrl_jax" / f"{module}.py"
        compileall.compile_dir(copy / "hasrl_jax", quiet=1)
        if not passes(copy, tests, chosen, write=True):
            raise SystemExit(f"{module}: its tests fail before anything is changed")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            compiled.unlink()  # or it would take the place of a change made in the same second
        survivors, end = 0, first
        for end, (what, changed) in enumerate(itertools.islice(changes(path.read_text()), first, None), first + 1):
            path.write_text(changed)
            survived = passes(copy, tests, chosen)
            survivors += survived
            print(f"  {end} {'UNNOTICED' if survived else 'noticed'} {module}.py:{what}", flush=True)
    print(f"{module}: {end - first - survivors} of {end - first} noticed", flush=True)


def main(modules: list[str]) -> None:
    os.environ |= {"JAX_PLATFORMS": "cpu", "NPROC": "1", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    for name in LOADED:
        importlib.import_module(name)
    for argument in modules or MODULES:
        module, _, first = argument.partition(":")
        run(module, int(first or 0))


if __name__ == "__main__":
    main(sys.argv[1:])
