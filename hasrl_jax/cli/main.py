"""`hasrl PROGRAM ...`: one program with sub-commands, the same as `python -m hasrl_jax PROGRAM ...`."""

import contextlib
import difflib
import importlib
import os
import signal
import sys
from collections.abc import Callable

# name -> (module with `main(arguments) -> exit status`, one line of help); modules load only when they are run
PROGRAMS = {
    "demo": ("hasrl_jax.cli.demo", "watch a released policy walk, at once"),
    "train": ("hasrl_jax.cli.train", "train a policy, or continue a run"),
    "evaluate": ("hasrl_jax.cli.evaluate", "play a policy and measure it; a whole scorecard with --scorecard"),
    "render": ("hasrl_jax.cli.render", "film a policy"),
    "viewer": ("hasrl_jax.cli.viewer", "watch and steer a policy in the browser or in MuJoCo's window"),
    "export": ("hasrl_jax.cli.export", "write a policy to one file: NumPy arrays, ONNX or StableHLO"),
    "figures": ("hasrl_jax.cli.figures", "curves of runs: learning curve, the paper's figures 3 and 4"),
    "sweep": ("hasrl_jax.cli.sweep", "train many times with settings that Optuna proposes"),
    "runs": ("hasrl_jax.cli.runs", "list runs and how far they have come"),
    "compare": ("hasrl_jax.cli.compare", "several runs side by side on one page: curves, settings, scorecards"),
    "pictures": ("hasrl_jax.cli.pictures", "how a policy walks: contacts, reward terms"),
    "gaits": ("hasrl_jax.cli.gaits", "record the library of gaits that a policy walks"),
    "bench": ("hasrl_jax.cli.bench", "timed figures: collector, learner, scaling, peers, parity"),
    "completion": ("hasrl_jax.cli.completion", "what makes bash or zsh complete programs and options"),
    "doctor": ("hasrl_jax.cli.doctor", "what this machine has and lacks"),
}

LEAST_FILES = 64  # libraries, a checkpoint that is being written, and a few workers
MOST_FILES = 8192  # each worker needs one
WINDOWS = (
    "error: hasrl_jax runs on Linux and macOS; on Windows install it inside WSL 2 (in PowerShell: wsl --install), "
    "where its workers can inherit file descriptors; docs/troubleshooting.md says more"
)


def start(program: str, arguments: list[str] | None = None) -> int:
    """Runs a program; returns its exit status. Until it is loaded, Ctrl-C ends it on one line.

    Args:
      program: one of PROGRAMS.
      arguments: default: those of this process.
    """
    if sys.platform == "win32":
        print(WINDOWS, file=sys.stderr)
        return 1
    if not _may_open_files():
        return 1
    for descriptor in (0, 1, 2):  # one that is closed would soon be a file of ours, and what is printed would go there
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdout", "stderr"):  # what we import may not expect them to be missing
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (open to the end)
    handler = signal.getsignal(signal.SIGINT)
    if handler is not signal.SIG_IGN:  # as in the background of a shell
        signal.signal(signal.SIGINT, _leave)
    main_of: Callable[[list[str]], int] = importlib.import_module(PROGRAMS[program][0]).main
    signal.signal(signal.SIGINT, handler)
    return main_of(sys.argv[1:] if arguments is None else arguments)


def _may_open_files() -> bool:
    """Whether enough files may be open at once; takes up to MOST_FILES of what the system grants."""
    import resource  # not on Windows

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft < most:
        with contextlib.suppress(OSError, ValueError):  # the system grants less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            soft = most
    if soft < LEAST_FILES:
        text = f"at most {soft} files may be open at once; expected {LEAST_FILES} or more (ulimit -n)"
        os.write(2, f"error: {text}\n".encode())
    return soft >= LEAST_FILES


def _leave(*_: object) -> None:
    """Ends the process at once: there is nothing to tidy, and an import that is cut short leaves nothing usable."""
    os.write(2, b"interrupted\n")
    os._exit(130)


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    argv = sys.argv[1:] if argv is None else argv
    sys.path.insert(0, os.getcwd())  # as `python -m` does: a task may lie in the working directory
    if argv in (["--version"], ["-V"]):
        print(importlib.import_module("hasrl_jax").__version__)
        return 0
    if not argv or argv[0] in ("-h", "--help"):
        print("usage: hasrl PROGRAM ...\n\nprograms:")
        for name, (_, text) in PROGRAMS.items():
            print(f"  {name:10s} {text}")
        print("\nhasrl PROGRAM --help tells the options of one.")
        return 0
    if argv[0] not in PROGRAMS:
        closest = difflib.get_close_matches(argv[0], PROGRAMS, n=1)
        hint = f"did you mean {closest[0]}?" if closest else f"expected one of {', '.join(PROGRAMS)}"
        print(f"error: got {argv[0]!r}; {hint}", file=sys.stderr)
        return 2
    return start(argv[0], argv[1:])


if __name__ == "__main__":
    sys.exit(main())
