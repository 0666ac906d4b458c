"""`endopilot completion`: a script with which bash and zsh complete commands, their options, and options' choices."""

from __future__ import annotations

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


def completion_command() -> None:
    """Print a script with which bash and zsh complete commands, options and choices; files where none of them fits.

    `endopilot completion > ~/.endopilot-completion`, and `source ~/.endopilot-completion` in ~/.bashrc or ~/.zshrc.
    """
    cases = []
    for name in COMMANDS:
        leaves = [leaf for option in command_of(name).options() for leaf in option.leaves() if not leaf.positional]
        chosen = [(leaf.flags[-1], leaf.takes[1:-1].replace(",", " ")) for leaf in leaves if leaf.takes[:1] == "{"]
        cases += [f'    "{name} {flag}") words="{choices}";;' for flag, choices in chosen]
        cases += [f'    "{name} "*) words="{" ".join(leaf.flags[-1] for leaf in leaves)} --help --help-all --config";;']
    print(SCRIPT.format(cases="\n".join(cases), names=" ".join(COMMANDS)), end="")
