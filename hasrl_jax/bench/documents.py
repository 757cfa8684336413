"""The tables of the documents, written from the figures that the benchmarks keep in `benchmarks/results/`.

A document marks where the tables of a benchmark stand:

    <!-- bench collector -->
    <!-- end -->
"""

import importlib
import json
import re
from functools import partial
from pathlib import Path

from hasrl_jax.errors import HasrlError

BLOCK = re.compile(r"<!-- bench (?P<name>[\w-]+) -->\n(?P<text>.*?)<!-- end -->", re.DOTALL)


class DocumentError(HasrlError):
    """A document asks for figures that there are none of."""


def refresh(documents: Path, results: Path) -> list[Path]:
    """Writes every marked block anew; returns the documents that changed.

    Args:
      documents: folder of the Markdown files.
      results: folder of NAME.json, as `bench BENCH --json` writes them.

    Raises:
      DocumentError: a block names a benchmark whose figures are not there.
    """
    changed = []
    for path in sorted(documents.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        refreshed = BLOCK.sub(partial(_block, path, results), text)
        if refreshed != text:
            path.write_text(refreshed, encoding="utf-8")
            changed.append(path)
    return changed


def _block(document: Path, results: Path, found: re.Match[str]) -> str:
    """The block of one benchmark: how and where it was measured, then its tables."""
    name = found["name"]
    path = results / f"{name}.json"
    if not path.is_file():
        raise DocumentError(f"{document}: the block 'bench {name}' needs {path}; write it with bench --json {path}")
    report = json.loads(path.read_text(encoding="utf-8"))
    tables = importlib.import_module(f"hasrl_jax.bench.{report['bench']}").tables(report["figures"])
    versions = ", ".join(f"{package} {report['versions'][package]}" for package in ("jax", "mujoco"))
    machine = f"{report['cores']} cores ({report['cpu']}), load {report['load_average']:.1f} at the start"
    head = f"`{report['command']}`\n\nMeasured on {report['date'][:10]}: {machine}; {versions}.\n"
    return f"<!-- bench {name} -->\n{head}\n{tables}\n<!-- end -->"
