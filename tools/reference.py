"""Pages of the site that are written from the code: settings, tables of the tasks, metrics, commands, modules."""

import contextlib
import dataclasses
import hashlib
import importlib
import inspect
import io
import os
import re
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args, get_origin

import hasrl_jax
from hasrl_jax.cli.main import PROGRAMS
from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.describe import descriptions
from hasrl_jax.config.files import recipe
from hasrl_jax.config.limits import Limits
from hasrl_jax.config.schema import StageConfig, available_cores
from hasrl_jax.config.tasks import BUILT_IN
from hasrl_jax.envs.cassie import rewards
from hasrl_jax.envs.cassie import task as cassie
from hasrl_jax.envs.cassie.settings import RewardConfig
from hasrl_jax.envs.layout import Entry, places
from hasrl_jax.envs.registry import make_task
from hasrl_jax.envs.task import Task
from hasrl_jax.policy.loading import RELEASED, load_policy_parameters
from hasrl_jax.runs.fields import FIELDS

ROOT = Path(hasrl_jax.__file__).parents[1]
LESS_IN_SEARCH = "---\nsearch: {boost: 0.2}\n---\n\n"  # what is written for people comes first
ENDS = re.DOTALL | re.MULTILINE
LAST_GROUPS = ("__init__", "__main__")


def pages() -> dict[str, str]:
    """Every generated page: path below docs/ -> Markdown."""
    return {
        "reference/configuration.md": configuration(),
        "reference/tables.md": task_tables(),
        "reference/metrics.md": metrics(),
        "reference/commands.md": command_lines(),
        "changelog.md": from_root("CHANGELOG.md"),
        "contributing.md": from_root("CONTRIBUTING.md"),
        "security.md": from_root("SECURITY.md"),
        **modules(),
    }


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]  # what looks like a tag of HTML is none
    return (
        "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in line) + " |" for line in lines
        )
        + "\n"
    )


def configuration() -> str:
    """Every field of a configuration with its default, what is accepted, and what it means."""
    parts = [
        "# Configuration",
        "Written from `hasrl_jax/config/schema.py` and `hasrl_jax/envs/cassie/settings.py`. A YAML file names only "
        "what it changes from the defaults; on the command line a field is `--group.field`, with hyphens for "
        "underscores: `--ppo.max-kl 0.02`, `--cassie.command.forward-m-s -0.3 1.0`. The limits are enforced: a value "
        "outside of them is refused by name before anything starts. The column of the recipe says what "
        "`configs/cassie_walk.yaml`, which is used when no file is named, has instead of the default.",
        *_groups(from_dict({"task": "cassie"}), recipe("cassie"), "", 2),
        "## stages",
        "A list of changes on the way, see [architecture](../architecture.md). Each has:",
        _fields(StageConfig(), StageConfig(), ""),
    ]
    return "\n\n".join(parts) + "\n"


def _groups(settings: Any, recipe_has: Any, prefix: str, level: int) -> Iterator[str]:
    """A heading and a table for the plain fields of a group, then the groups inside it."""
    if not prefix:
        yield "## The run"
    if own := _fields(settings, recipe_has, prefix):
        yield own
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            name = prefix + field.name
            yield f"{'#' * min(level, 3)} {name}"
            yield from _groups(value, getattr(recipe_has, field.name), f"{name}.", level + 1)


def _fields(settings: Any, recipe_has: Any, prefix: str) -> str:
    hints = typing.get_type_hints(type(settings), include_extras=True)
    meanings, rows = descriptions(type(settings)), []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value) or field.name == "stages":
            continue
        instead = getattr(recipe_has, field.name)
        default = "one per core" if field.default_factory is available_cores else _value(value)
        changed = _value(instead) if instead != value else ""
        rows.append([f"`{prefix}{field.name}`", default, changed, _accepted(hints[field.name]), meanings[field.name]])
    return table(["field", "default", "recipe", "accepted", "meaning"], rows) if rows else ""


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_value(end) for end in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}" if value != round(value, 6) else str(value)
    return f"{value:,}".replace(",", "_") if isinstance(value, int) else str(value) or '""'


def _accepted(hint: Any) -> str:
    """What a field takes, from its type."""
    if get_origin(hint) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(hint))
    for limits in getattr(hint, "__metadata__", ()):
        if isinstance(limits, Limits):
            ends = "low and high: " if get_origin(get_args(hint)[0]) is tuple else ""
            whole = "whole, " if get_args(hint)[0] is int else ""
            return f"{ends}{whole}{limits.low:g} to {limits.high:g}"
    return {bool: "true, false", str: "text"}.get(hint, "mapping")


def task_tables() -> str:
    """What every built-in task's policy sees, decides and can be told, in order."""
    parts = [
        "# Observations, actions, commands",
        "Written from the tables of the tasks (`Task.observation`, `Task.action`, `Task.commands`). Everything is "
        "float32. *Mirror* is the sign of each number in the left-right mirror image; the numbers of legs also change "
        "places. *Error* is the half width of the error of a noisy measurement, where noise is switched "
        "on. Actions are clipped to [-1, 1].",
    ]
    parts += _task_parts("cassie")
    heading = make_task(from_dict({"cassie": {"command": {"frame": "heading"}}}, recipe("cassie")))
    targets = ", ".join(f"{value:.4f}" for value in cassie.NEUTRAL_RAD)
    parts += [
        "### Commands in the heading frame",
        "With `cassie.command.frame: heading` the observation ends with four commands instead of two, "
        f"{heading.observation_size} numbers in all:",
        _commands(heading),
        "### From action to torque of cassie",
        f"An action of 0 targets the initial pose, in the order above: {targets} rad. The PD loop that follows the "
        "target runs inside MuJoCo at every physics step; its gains and torque limits are in "
        "`hasrl_jax/envs/cassie/cassie.xml`.",
        "### Reward terms of cassie",
        "`reward/TERM` of `info` and of the metrics; the weights are those of `cassie.reward`, and their sum is "
        "multiplied by `cassie.reward.scale`. [From the paper to the code](../paper_to_code.md) has the formulas.",
        table(
            ["term", "weight", "weight in the recipe"],
            [
                [
                    f"`{term}`",
                    f"{getattr(RewardConfig(), term):g}",
                    f"{getattr(recipe('cassie').settings.reward, term):g}",
                ]
                for term in rewards.TERMS
            ],
        ),
        "### Measures of cassie",
        "In `info` by their names, and in what `hasrl evaluate` reports.",
        table(
            ["measure", "meaning"],
            [[f"`{name}`", _comment(cassie, f'"{name}"')] for name in (*cassie.MEASURES, *cassie.HEADING_MEASURES)],
        ),
    ]
    parts += [part for name in BUILT_IN if name != "cassie" for part in _task_parts(name)]
    return "\n\n".join(parts) + "\n"


def _task_parts(name: str) -> list[str]:
    """What is said of every task."""
    task = make_task(recipe(name))
    parts = [
        f"## {name}",
        _layout_table("Observation", task.observation),
        _layout_table("Action", task.action),
    ]
    if task.commands:
        parts += [f"### Commands of {name}", _commands(task)]
    if task.with_push:
        parts.append(f"A push of the viewer, of a film or of `TaskEnv.push` lasts {task.push_s:g} s.")
    return parts


def _layout_table(title: str, entries: tuple[Entry, ...]) -> str:
    rows = []
    for entry, place in zip(entries, places(entries).values(), strict=True):
        index = str(place.start) if entry.size == 1 else f"{place.start} to {place.stop - 1}"
        signs = " ".join("+" if sign > 0 else "−" for sign in entry.mirror)
        meaning = "; ".join(text for text in (_numbers(entry), entry.note) if text)
        error = f"{entry.noise:g}" if entry.noise else ""
        rows.append([index, f"`{entry.name}`", entry.unit, signs, error, meaning])
    size = sum(entry.size for entry in entries)
    return f"### {title}, {size} {'numbers' if size > 1 else 'number'}\n\n" + table(
        ["index", "quantity", "unit", "mirror", "error", "numbers"], rows
    )


def _numbers(entry: Entry) -> str:
    """What the numbers of a quantity are, in order."""
    if entry.legs and entry.parts:
        left = (name.removeprefix("left-") for name in entry.parts[: entry.size // 2])
        return f"left {', '.join(left)}; then the right leg's"
    return ", ".join(entry.parts)


def _comment(module: ModuleType | None, declaration: str) -> str:
    """The first comment behind what `module` declares, before anything else is declared there.

    Args:
      module: where to look.
      declaration: how it begins, a regular expression.
    """
    match = module and re.search(rf"{declaration}((?:(?!Entry\().)*?)  # (.*?)$", inspect.getsource(module), ENDS)
    return match[2] if match and "\n)" not in match[1] else ""


def _commands(task: Task) -> str:
    rows = [
        [
            *(f"`{command.name}`", command.unit, f"{command.default:g}", _value(command.drawn), _value(command.limits)),
            f"`{command.measure}`",
        ]
        for command in task.commands
    ]
    return table(["command", "unit", "default", "drawn from", "accepted", "followed by the measure"], rows)


def metrics() -> str:
    """Every field of metrics.jsonl."""
    rows = [[f"`{name}`", field.unit, field.meaning, field.only] for name, field in FIELDS.items()]
    return "\n\n".join(
        [
            "# Metrics",
            "`metrics.jsonl` in the run directory has one JSON object per iteration; TensorBoard shows the same "
            "numbers, grouped. What is unknown or not finite is `null`. Written from `hasrl_jax/runs/fields.py`, which "
            "a test compares with the records of runs.",
            table(["field", "unit", "meaning", "only"], rows),
            "To read it:",
            '```python\nimport json\nfrom pathlib import Path\n\nlines = Path("runs/my_run/metrics.jsonl").read_text()'
            '.splitlines()\nreturns = [json.loads(line)["episode_return_train"] for line in lines]\n```',
        ]
    )


def command_lines() -> str:
    """What each program says of itself."""
    parts = [
        "# Command lines",
        "`hasrl PROGRAM` and `python -m hasrl_jax PROGRAM` are the same. Exit status: 0 done, 1 failed, 2 a value that "
        "cannot work, 130 interrupted.",
    ]
    for program, (module, summary) in PROGRAMS.items():
        parts += [f"## hasrl {program}", f"{summary[0].upper()}{summary[1:]}."]
        if program == "train":
            parts.append(
                "`--config FILE` (or the name of a shipped one), `--resume DIR`, `--init-policy SOURCE`, `--task "
                "NAME`, `--num-workers N`, `--stages YAML`, and every field of the [configuration](configuration.md)."
            )
        else:
            parts.append(f"```text\n{_help(module)}\n```")
    return "\n\n".join(parts) + "\n"


def _help(module: str) -> str:
    os.environ["COLUMNS"] = "100"
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        importlib.import_module(module).main(["--help"])
    return shown.getvalue().strip()


def from_root(name: str) -> str:
    """A document of the repository's root, with links that hold inside docs/."""
    text = (ROOT / name).read_text(encoding="utf-8")
    text = re.sub(r"\]\((CHANGELOG|CONTRIBUTING|SECURITY)\.md", lambda link: f"]({link[1].lower()}.md", text)
    return re.sub(r"\]\(docs/", "](", text)


def policy_facts(name: str) -> str:
    """What the file of a released policy says of itself, as a table."""
    path = RELEASED[name]
    config, parameters = load_policy_parameters(None, name)
    commands = "; ".join(
        f"{command.name.replace('_', ' ')} {_value(command.drawn)} {command.unit}"
        for command in make_task(config).commands
    )
    rows = [
        ["file", f"`hasrl_jax/policy/released/{path.name}`, {path.stat().st_size / 1000:.0f} kB"],
        ["SHA-256", f"`{hashlib.sha256(path.read_bytes()).hexdigest()}`"],
        ["numbers", f"{sum(array.size for array in parameters.values()):,} in both networks and the statistics"],
        ["sees, decides", f"{make_task(config).observation_size} and {make_task(config).action_size} numbers"],
        ["commands that it was trained for", f"{commands}; frame: {config.settings.command.frame}"],
        ["ground", config.settings.terrain.kind],
        [
            "an episode ends",
            f"below {config.settings.termination.min_height_m:g} m or tilted by more than "
            f"{config.settings.termination.max_tilt_deg:g}°",
        ],
    ]
    return table(["", ""], rows)


def modules() -> dict[str, str]:
    """A page for every package of hasrl_jax, with the modules in it, and one with all of them."""
    package = Path(hasrl_jax.__file__).parent
    groups: dict[str, list[str]] = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        if path.stem in LAST_GROUPS or (len(parts) == 1 and parts[0] in PROGRAMS):
            continue
        group = "hasrl_jax" if len(parts) == 1 else parts[0]
        groups.setdefault(group, []).append(".".join(("hasrl_jax", *parts)))
    pages = {}
    for group, names in groups.items():
        about = inspect.getdoc(importlib.import_module(f"hasrl_jax.{group}" if group != "hasrl_jax" else group)) or ""
        body = "\n\n".join(f"## {name}\n\n::: {name}" for name in names)
        pages[f"reference/api/{group}.md"] = f"{LESS_IN_SEARCH}# {group}\n\n{about}\n\n{body}\n"
    listed = "\n".join(
        f"- [{group}]({group}.md): " + ", ".join(f"`{name.rpartition('.')[2]}`" for name in names)
        for group, names in groups.items()
    )
    pages["reference/api/index.md"] = (
        "# API\n\nEvery module with its public functions, from their docstrings. "
        "[Architecture](../../architecture.md) says which part may import which.\n\n" + listed + "\n"
    )
    return pages
