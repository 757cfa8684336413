"""The documents name files, functions, settings, programs and options that exist."""

import ast
import dataclasses
import re
import sys
from pathlib import Path

import pytest

import hasrl_jax
from hasrl_jax.cli.completion import OWN
from hasrl_jax.cli.main import PROGRAMS
from hasrl_jax.cli.parsing import SHORTHAND, options_of_fields
from hasrl_jax.config.convert import from_dict, to_dict
from hasrl_jax.runs.directory import CONFIG_FILE

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import reference

PACKAGE = Path(hasrl_jax.__file__).parent
ROOT = PACKAGE.parent
DOCUMENTS = (
    *("docs/architecture.md", "docs/deploy.md", "docs/paper_to_code.md", "docs/reliability.md"),
    *("CONTRIBUTING.md", "README.md"),
    *(f"docs/{name}.md" for name in ("index", "start", "install", "concepts", "howto", "troubleshooting", "faq")),
    *(f"docs/tutorials/{name}.md" for name in ("play", "train")),
    *(f"docs/policies/{name}.md" for name in ("index", "released")),
    *(f"docs/policies/released-{name}.md" for name in ("steer", "fast", "stairs", "imitate", "gaits")),
)
FILE = re.compile(r"[\w./-]+\.(?:py|yaml|xml|md|npz|ipynb|lock|toml)")
COMMAND = re.compile(r"(?:\bhasrl |-m hasrl_jax\.)([a-z]+) ([^|#;&`\n]*)")
OPTION = re.compile(r"(?<!\S)--[a-z][\w.-]*")
NAME = re.compile(r"[A-Za-z_]\w*(?:\.\w+)*")
PLACES = (ROOT, PACKAGE, ROOT / "docs", ROOT / "tests")


def _spans(text: str) -> list[str]:
    """What stands between backticks, outside code blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def _find(name: str) -> Path | None:
    return next((place / name for place in PLACES if (place / name).exists()), None)


def _definitions(path: Path) -> set[str]:
    """Names that a Python file defines, those inside its classes too; for any other file, its words."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return set(re.findall(r"\w+", text))
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Name | ast.arg):
            found.add(node.id if isinstance(node, ast.Name) else node.arg)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def _is_setting(name: str) -> bool:
    value = from_dict({})
    for part in name.split("."):
        if not dataclasses.is_dataclass(value) or not hasattr(value, part):
            return False
        value = getattr(value, part)
    return True


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_file_named_exists(document: str) -> None:
    spans = [span for span in _spans((ROOT / document).read_text()) if FILE.fullmatch(span)]
    missing = [span for span in spans if not _find(span) and span != CONFIG_FILE]  # which every run directory has
    assert not missing


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_link_leads_somewhere(document: str) -> None:
    text = (ROOT / document).read_text()
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    folder = (ROOT / document).parent
    inside = {(folder / target).resolve() for target in targets if target and not target.startswith("http")}
    generated = {ROOT / "docs" / page for page in reference.pages()}
    missing = [target for target in inside - generated if not target.exists()]
    assert not missing


def test_every_function_that_the_paper_leads_to_is_in_the_file_named_beside_it() -> None:
    for line in (ROOT / "docs/paper_to_code.md").read_text().splitlines():
        for cell in line.split("|"):
            files = [path for span in _spans(cell) if FILE.fullmatch(span) and (path := _find(span))]
            known = set().union(*map(_definitions, files)) if files else set()
            for span in _spans(cell):
                if not files or FILE.fullmatch(span) or not NAME.fullmatch(span) or _is_setting(span):
                    continue
                assert set(span.split(".")) <= known, f"`{span}` in: {cell.strip()}"


def test_every_setting_named_exists() -> None:
    groups = {
        field.name for field in dataclasses.fields(from_dict({})) if dataclasses.is_dataclass(field.default_factory)
    }
    for document in DOCUMENTS:
        for span in _spans((ROOT / document).read_text()):
            name = span.partition(":")[0].strip()
            if re.fullmatch(r"[a-z]+(\.[a-z_0-9]+)+", name) and name.split(".")[0] in groups | {"cassie"}:
                assert _is_setting(name), f"{document}: `{span}`"


def _commands(text: str) -> list[tuple[str, list[str]]]:
    """(program, its options) of every command in a block of code or between backticks."""
    blocks = re.findall(r"```.*?```", text, flags=re.DOTALL)
    shown = "\n".join([*blocks, *_spans(text)]).replace("\\\n", " ")
    return [(program, OPTION.findall(rest)) for program, rest in COMMAND.findall(shown)]


def _options(program: str) -> set[str]:
    """What the source of a program, and of what all of them share, calls an option."""
    files = [PACKAGE / "cli" / f"{program}.py", PACKAGE / "cli" / "options.py"]
    files += PACKAGE.glob("bench/*.py") if program == "bench" else []
    return {name for file in files for name in re.findall(r'"(--[a-z][\w-]*)"', file.read_text())}


def test_every_program_and_option_named_exists() -> None:
    fields = {*options_of_fields(to_dict(from_dict({"task": "cassie"}))), *OWN, *SHORTHAND}
    seen = 0
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*/*.md")]:
        text = path.read_text(encoding="utf-8")
        if '```python title="' in text:  # brings options of its own; tests/test_tutorials.py runs its commands
            continue
        for program, options in _commands(text):
            assert program in PROGRAMS, f"{path}: hasrl {program}"
            known = _options(program) | fields
            for option in options:
                seen += 1
                assert option.replace("_", "-") in known, f"{path}: hasrl {program} {option}"
    assert seen > 100
