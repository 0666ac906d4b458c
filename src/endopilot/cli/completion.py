"""`endopilot completion`: a script with which bash, zsh and fish complete commands, options, and options' choices."""

from __future__ import annotations

import shlex
from typing import Literal

from tyro.conf import Positional

from endopilot.cli import COMMANDS, command_of

SCRIPT = """\
# Tab completes `endopilot`: keep this in a file, and `source` the file from ~/.bashrc or ~/.zshrc.
[ -n "$ZSH_VERSION" ] && autoload -U +X compinit bashcompinit && compinit && bashcompinit
_endopilot() {{
  local words before="${{COMP_WORDS[COMP_CWORD-1]}}"
  case "${{COMP_WORDS[1]}} $before" in
{cases}
  esac
  [ "$COMP_CWORD" = 1 ] && words="{names}"
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _endopilot endopilot
"""


def completion_command(shell: Positional[Literal["bash", "zsh", "fish"]] = "bash", /) -> None:
    """Print a script with which a shell completes commands, options and choices; files where none of them fits.

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
        cases += [f'    "{name} {flag}") words="{choices}";;' for flag, choices in chosen.items()]
        cases += [f'    "{name} "*) words="{" ".join(flags)}";;']
        fish += [f"complete -c endopilot -n __fish_use_subcommand -f -a {name} -d {shlex.quote(summary)}"]
        seen = f"complete -c endopilot -n '__fish_seen_subcommand_from {name}' -l"
        fish += [f"{seen} {flag[2:]} {f'-xa {chosen[flag]!r}' if flag in chosen else ''}" for flag in flags]
    print("\n".join(fish) if shell == "fish" else SCRIPT.format(cases="\n".join(cases), names=" ".join(COMMANDS)))
