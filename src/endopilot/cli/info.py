"""`endopilot sample`, `completion` and `info`: data to try, Tab in the shell, and this machine for a bug report."""

from __future__ import annotations

import shlex
from typing import Literal

from endopilot import _core
from endopilot.cli import COMMANDS, command_of
from endopilot.cli.arguments import Figures
from endopilot.extras import extras_present
from endopilot.files import manifest
from endopilot.imaging.sample import fetch_sample

SCRIPT = """\
# Tab completes `endopilot`: keep this in a file, and `source` the file from ~/.bashrc or ~/.zshrc.
[ -n "$ZSH_VERSION" ] && autoload -U +X compinit bashcompinit && compinit && bashcompinit
_endopilot() {{
  local words word="${{COMP_WORDS[COMP_CWORD]}}"
  case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}} $word" in
{cases}
  esac
  [ "$COMP_CWORD" = 1 ] && words="{names}"
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _endopilot endopilot
"""


def completion_command(shell: Literal["bash", "zsh", "fish"] = "bash", /) -> None:
    """Print a script with which a shell completes commands, choices, and options after a dash; else files.

    `endopilot completion > ~/.endopilot-completion`, and `source ~/.endopilot-completion` in ~/.bashrc or ~/.zshrc; or
    `endopilot completion fish > ~/.config/fish/completions/endopilot.fish`.

    Args:
        shell: whose script; that of bash and zsh is the same.
    """
    cases, fish = [], []
    for name, summary in COMMANDS.items():
        leaves = [leaf for option in command_of(name).options() for leaf in option.leaves() if not leaf.positional]
        choices = {leaf.flags[-1]: leaf.takes[1:].partition("}")[0] for leaf in leaves if leaf.takes[:1] == "{"}
        chosen = {flag: names.replace(",", " ") for flag, names in choices.items()}
        flags = [leaf.flags[-1] for leaf in leaves] + ["--help", "--help-all", "--config"]
        cases += [f'    "{name} {flag} "*) words="{choices}";;' for flag, choices in chosen.items()]
        cases += [f'    "{name} "*" -"*) words="{" ".join(flags)}";;']
        fish += [f"complete -c endopilot -n __fish_use_subcommand -f -a {name} -d {shlex.quote(summary)}"]
        seen = f"complete -c endopilot -n '__fish_seen_subcommand_from {name}' -l"
        fish += [f"{seen} {flag[2:]} {f'-xa {chosen[flag]!r}' if flag in chosen else ''}" for flag in flags]
    print("\n".join(fish) if shell == "fish" else SCRIPT.format(cases="\n".join(cases), names=" ".join(COMMANDS)))


def sample_command(name: Literal["cta-thorax"] = "cta-thorax", /) -> None:
    """Download a real thoracic CT angiogram, check it, and print its path, licence and source.

    Args:
        name: which sample.
    """
    print(fetch_sample(name))


def info_command() -> Figures:
    """Print versions, machine, the level of the rod core for this processor, and which extras are installed."""
    facts = manifest(config=None)
    figures = {"commit": facts["commit"], **facts["versions"], **facts["machine"], "core": _core.LEVEL}
    there = extras_present()
    return figures | {
        name: " ".join(e for e in there if there[e] is is_there) or "-"
        for name, is_there in (("extras", True), ("missing", False))
    }
