"""`hasrl completion SHELL`: prints what makes bash or zsh complete programs and options.

hasrl completion bash > ~/.local/share/bash-completion/completions/hasrl
hasrl completion zsh >> ~/.zshrc
"""

import argparse
import sys
from collections.abc import Iterable

from hasrl_jax.cli.options import OneLineParser
from hasrl_jax.cli.parsing import SHORTHAND, options_of_fields, run
from hasrl_jax.config import tasks
from hasrl_jax.config.convert import to_dict
from hasrl_jax.config.files import CONFIG_FOLDER

OWN = ("--config", "--resume", "--task", "--init-policy", "--stages", "--help")  # of `train`, besides single fields
SCRIPT = """
_hasrl() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} words
  if [ "$COMP_CWORD" -eq 1 ]; then words="{programs}"
  elif [ "$before" = --config ]; then words="{configs}"
  elif [ "$before" = --task ]; then words="{tasks}"
  elif [ "${{COMP_WORDS[1]}}" = train ] || [ "${{COMP_WORDS[1]}}" = sweep ]; then
    case $current in -*) words="{options}";; esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current") $([ "$COMP_CWORD" -gt 1 ] && compgen -f -- "$current"))
}}
complete -o filenames -F _hasrl hasrl
"""
BEFORE = {"bash": "", "zsh": "autoload -U +X bashcompinit && bashcompinit\n"}


def script(shell: str, programs: Iterable[str]) -> str:
    """What the shell is to read; `programs`: those of `hasrl`."""
    offered = tasks.offered()
    fields = {option for task in offered for option in options_of_fields(to_dict(tasks.config_class(task)()))}
    return BEFORE[shell] + SCRIPT.lstrip().format(
        programs=" ".join(programs),
        configs=" ".join(sorted(path.stem for path in CONFIG_FOLDER.glob("*.yaml"))),
        tasks=" ".join(offered),
        options=" ".join([*OWN, *SHORTHAND, *sorted(fields)]),
    )


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = OneLineParser(
        prog="hasrl completion", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shell", choices=tuple(BEFORE))
    known = parser.parse_args(sys.argv[1:] if argv is None else argv)
    from hasrl_jax.cli.main import PROGRAMS

    return run(lambda: print(script(known.shell, PROGRAMS), end=""))
