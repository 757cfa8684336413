"""Changes lines of the mathematics one by one and runs the tests that are for them: `make mutation`, about two hours.

Every mutant that no test notices is printed; docs/mutation.md says why those that are left are left. Works on a copy.
Options: names of modules as below; none runs all of them.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import TestOutcome

ROOT = Path(__file__).parents[1]
PROPERTIES = "tests/test_properties.py"
# The tests of each module, those first that fail soonest.
MODULES = {
    "learn/returns": f"tests/learn/test_returns.py {PROPERTIES} -k 'not minibatches'",
    "learn/batching": f"tests/learn/test_batching.py {PROPERTIES} -k minibatches",
    "learn/distributions": "tests/learn/test_distributions.py",
    "learn/losses": "tests/learn/test_ppo.py tests/learn/test_ppo_oracle.py "
    "-k 'hand or fresh_data or stale or lag or gradients or mask_padding or oracle'",
    "learn/ppo": "tests/learn/test_ppo_oracle.py tests/learn/test_ppo.py",
    "collect/buffer": f"tests/learn/test_batching.py {PROPERTIES} -k 'pad or slots'",
    "envs/layout": f"{PROPERTIES} -k mirror",
    "envs/cassie/clock": f"tests/envs/test_clock.py {PROPERTIES} -k clock",
    "evaluate/statistics": "tests/evaluate/test_statistics.py",
}
# One change of each kind where the tool would make ten: + to -, < to <=, a number to its neighbours, a negation away.
CONFIG = """
[cosmic-ray]
module-path = "hasrl_jax/{module}.py"
timeout = 600.0
excluded-modules = []
test-command = "{python} -m pytest -x -q -p no:cacheprovider {tests}"
[cosmic-ray.distributor]
name = "local"
[cosmic-ray.filters.operators-filter]
exclude-operators = [
  'core/ReplaceBinaryOperator_(?!(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul|Mod_Mul|FloorDiv_Mul|BitAnd_BitOr)$)',
  'core/ReplaceComparisonOperator_(?!(Gt_GtE|GtE_Gt|Lt_LtE|LtE_Lt|Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is|In_NotIn)$)',
  'core/ReplaceUnaryOperator_(?!Delete_)',
]
"""


def run(module: str, copy: Path) -> tuple[int, list[str]]:
    """The mutants of a module that were tried, and descriptions of the survivors."""
    config, session = copy / "mutation.toml", copy / "mutation.sqlite"
    config.write_text(CONFIG.format(module=module, python=sys.executable, tests=MODULES[module]))
    # The compiler's optimisations would take more time than they save.
    environment = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    tools = Path(sys.executable).parent
    for command in (
        (tools / "cosmic-ray", "init", "--force", config, session),
        (tools / "cr-filter-operators", session, config),
        (tools / "cosmic-ray", "baseline", config),
        (tools / "cosmic-ray", "exec", config, session),
    ):
        subprocess.run(command, cwd=copy, env=environment, check=True, stdout=subprocess.DEVNULL)
    tried, survivors = 0, []
    with use_db(session, WorkDB.Mode.open) as database:
        for item, result in database.completed_work_items:
            if result.test_outcome is None:
                continue
            tried += 1
            if result.test_outcome == TestOutcome.SURVIVED:
                changed = [
                    line for line in result.diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")
                ]
                survivors.append(
                    f"{module}.py:{item.mutations[0].start_pos[0]} " + " -> ".join(map(str.strip, changed))
                )
    return tried, survivors


def main(modules: list[str]) -> None:
    tracked = subprocess.run(("git", "ls-files"), cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for module in modules or MODULES:
        with tempfile.TemporaryDirectory() as directory:
            for name in tracked.splitlines():
                target = Path(directory, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, target)
            tried, survivors = run(module, Path(directory))
        print(f"{module}: {tried - len(survivors)} of {tried} killed", *survivors, sep="\n  ", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
