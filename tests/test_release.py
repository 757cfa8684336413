"""What must agree before a release: versions, locks, and the commands of the workflows."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import hasrl_jax

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"^([\w.-]+)==([^\s;\\]+)", re.MULTILINE)


def _pins(path: Path) -> set[tuple[str, str]]:
    return set(PIN.findall(path.read_text()))


def test_the_version_is_cited_and_has_a_dated_entry() -> None:
    version = hasrl_jax.__version__
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$"
    assert re.search(heading, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert f"hasrl_jax-{version}-py3" in (ROOT / "docs/install.md").read_text()


@pytest.mark.parametrize("variant", ["cpu", "cuda"])
def test_images_install_what_the_lock_pins_by_hash(variant: str) -> None:
    text = (ROOT / f"docker/requirements-{variant}.lock").read_text()
    pins = set(PIN.findall(text))
    assert pins <= _pins(ROOT / "requirements.lock")
    entries = re.split(r"\n(?=\S)", text.strip())
    assert len(entries) == len(pins) and all("--hash=sha256:" in entry for entry in entries)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[<>=\[]", entry)[0].lower() for entry in project["dependencies"]}
    assert needed <= {name for name, _ in pins}
    assert any(name.startswith("jax-cuda12") for name, _ in pins) == (variant == "cuda")


def test_the_lock_pins_every_extra_that_the_makefile_names() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    locked = re.search(r"foreach name,([\w ]+),", (ROOT / "Makefile").read_text())
    assert locked and {"cuda", "mlflow", "viewer"} <= set(locked[1].split())
    needed = {re.split(r"[<>=\[]", entry)[0].lower() for name in locked[1].split() for entry in extras[name]}
    assert needed <= {name for name, _ in _pins(ROOT / "requirements.lock")}


def test_the_image_copies_what_there_is_and_builds_as_the_wheel() -> None:
    text = (ROOT / "Dockerfile").read_text()
    sources = [word for line in re.findall(r"^COPY (.*) \S+$", text, re.MULTILINE) for word in line.split()]
    assert len(sources) >= 6
    assert all((ROOT / source.replace("${VARIANT}", "cpu")).exists() for source in sources)
    (builder,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert builder in text


def test_workflows_call_targets_that_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    called: set[str] = set()
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        for job in yaml.safe_load(path.read_text())["jobs"].values():
            for step in job["steps"]:
                called |= set(re.findall(r"(?<=make )[a-z ]+|$", step.get("run", ""))[0].split())
    assert {"install", "lint", "type", "test", "docs", "wheel"} <= called <= targets
