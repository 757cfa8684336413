"""`hasrl completion SHELL`: prints what makes bash or zsh complete programs and options.

hasrl completion bash > ~/.local/share/bash-completion/completions/hasrl
hasrl completion zsh >> ~/.zshrc
"""

import argparse
import contextlib
import importlib
import io
import re
import sys
from collections.abc import Mapping

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import SHORTHAND, options_of_fields, run
from hasrl_jax.config import tasks
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.files import CONFIG_FOLDER
from hasrl_jax.policy.loading import RELEASED

OWN = ("--config", "--resume", "--task", "--init-policy", "--stages", "--help")  # of `train`, besides single fields
SCRIPT = """
_hasrl() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} words
  if [ "$COMP_CWORD" -eq 1 ]; then words="{programs}"
  elif [ "$before" = --config ]; then words="{configs}"
  elif [ "$before" = --task ]; then words="{tasks}"
  elif [ "$before" = --policy ] || [ "$before" = --init-policy ]; then words="{policies}"
  else case "${{COMP_WORDS[1]}} $current" in
{options}
  esac; fi
  COMPREPLY=($(compgen -W "$words" -- "$current") $([ "$COMP_CWORD" -gt 1 ] && compgen -f -- "$current"))
}}
complete -o filenames -F _hasrl hasrl
"""
BEFORE = {"bash": "", "zsh": "autoload -U +X bashcompinit && bashcompinit\n"}


def script(shell: str, programs: Mapping[str, tuple[str, str]]) -> str:
    """What the shell is to read; `programs`: those of `hasrl`, each with its module."""
    offered = tasks.offered()
    fields = {option for task in offered for option in options_of_fields(to_dict(tasks.config_class(task)()))}
    of_train = [*OWN, *SHORTHAND, *sorted(fields)]
    options = {name: [] if name == "train" else options_of(module) for name, (module, _) in programs.items()}
    options |= {name: options[name] + of_train for name in ("train", "sweep")}
    return BEFORE[shell] + SCRIPT.lstrip().format(
        programs=" ".join(programs),
        configs=" ".join(sorted(path.stem for path in CONFIG_FOLDER.glob("*.yaml"))),
        tasks=" ".join(offered),
        policies=" ".join(RELEASED),
        options="\n".join(f'    "{name} -"*) words="{" ".join(words)}";;' for name, words in options.items()),
    )


def options_of(module: str) -> list[str]:
    """The options that the help of a program names."""
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        importlib.import_module(module).main(["--help"])
    return sorted(set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", shown.getvalue())))


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = OneLineParser(
        prog="hasrl completion", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shell", choices=tuple(BEFORE))
    known = parser.parse_args(sys.argv[1:] if argv is None else argv)
    from hasrl_jax.cli.main import PROGRAMS

    return run(lambda: print(script(known.shell, PROGRAMS), end=""))
