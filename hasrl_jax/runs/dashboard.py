"""What a terminal shows of a run below its lines: returns, speed, where the time goes, processes, memory, films."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import psutil
from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

CURVE_POINTS = 48  # iterations in the small curves
BLOCKS = "▁▂▃▄▅▆▇█"
# Shares of an iteration's time: what is shown, the metric that has it, s
SHARES = (("waiting for data", "wait_seconds"), ("update", "update_seconds"), ("evaluation", "eval_seconds"))
BAR_WIDTH = 40


class Machine(NamedTuple):
    """The processes of the run and their memory."""

    processes: int  # besides this one
    memory_gb: float  # resident, all together
    free_gb: float  # that the machine has left


def machine() -> Machine:
    """As it is now; processes that end meanwhile do not count."""
    own = psutil.Process()
    children = own.children(recursive=True)
    memory = 0
    for process in [own, *children]:
        try:
            memory += process.memory_info().rss
        except psutil.Error:
            continue
    return Machine(len(children), memory / 1e9, psutil.virtual_memory().available / 1e9)


class History:
    """The last values of the metrics that are drawn as curves."""

    def __init__(self) -> None:
        names = ("episode_return_train", "episode_length_train", "env_steps_per_second")
        self.values = {name: deque[float](maxlen=CURVE_POINTS) for name in names}

    def add(self, record: Mapping[str, float | int | None]) -> None:
        """Takes what is drawn from an iteration's metrics."""
        for name, values in self.values.items():
            value = record.get(name)
            if value is not None:
                values.append(value)


def curve(values: Sequence[float]) -> str:
    """Values as a row of blocks, the lowest and the highest at its bounds: one character each."""
    low, high = min(values, default=0.0), max(values, default=0.0)
    scale = (len(BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(BLOCKS[round((value - low) * scale)] for value in values)


def view(
    record: Mapping[str, float | int | None],
    history: History,
    now: Machine,
    film: str,
    total_env_steps: int,
    left: str,
) -> RenderableType:
    """The whole of it.

    Args:
      record: metrics of the last iteration.
      history: of those before.
      now: processes and memory.
      film: the newest one; empty where there is none.
      total_env_steps: at which the run ends.
      left: the time until then, as text.
    """
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    for label, name, form in (
        ("return", "episode_return_train", ",.1f"),
        ("length", "episode_length_train", ",.0f"),
        ("steps/s", "env_steps_per_second", ",.0f"),
    ):
        values = history.values[name]
        table.add_row(label, format(values[-1], form) if values else "-", Text(curve(values), "cyan"))
    table.add_row("time", shares(record))
    lost = int(record.get("workers_lost") or 0)
    processes = f"{now.processes}" + (f", {lost} replaced" if lost else "")
    table.add_row("processes", processes, f"memory {now.memory_gb:.1f} GB, {now.free_gb:.1f} GB free")
    if film:
        table.add_row("film", Text(film))
    done = min(int(record.get("env_steps") or 0), total_env_steps)
    bar = Table.grid(padding=(0, 2))
    percent = f"{100 * done / total_env_steps:.0f}%"
    bar.add_row(ProgressBar(total=total_env_steps, completed=done, width=BAR_WIDTH), percent, left)
    return Group(table, bar)


def shares(record: Mapping[str, float | int | None]) -> str:
    """Where the time of the iteration went, in percent."""
    seconds = [(label, float(record.get(name) or 0.0)) for label, name in SHARES]
    total = sum(value for _, value in seconds)
    if not total:
        return "-"
    return ", ".join(f"{label} {100 * value / total:.0f}%" for label, value in seconds if value)
