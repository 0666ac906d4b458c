"""`endopilot verify`, `devices`, `sample`, `completion` and `info`: the core against closed forms, the known wires,
data to try, Tab in the shell, and this machine for a bug report. `info` is quick: functions import what is not."""

from __future__ import annotations

import shlex
from typing import Any, Literal

from endopilot import _core
from endopilot.cli import COMMANDS, command_of
from endopilot.cli.arguments import Answer, Figures
from endopilot.devices.catheter import catheter_yaml, list_catheters, read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.device_files import device_file, device_yaml, list_wires, user_devices
from endopilot.errors import InputError
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


def verify_command() -> Answer:
    """Compare the rod core with closed forms of free rods; print one row a case and its verdict.

    A row holds case, reference, value, error and bar. The exit code is 1 if an error exceeds its bar. In the source
    tree, `python -m benchmarks verification` also compares drives, walls, friction, catheters, moving vessels and an
    independent engine, and `python -m benchmarks --help` lists what else is measured.
    """
    from endopilot.verification.free_rod import CASES, run

    rows = [case.row() for case in run(CASES)]
    more = "more: `python -m benchmarks verification` in the source tree"
    return Answer(rows, [rows, more], passed=all(row["passed"] is not False for row in rows))


def devices_command(devices: tuple[str, ...] = (), /, *, tip_load: bool = False, yaml: bool = False) -> Answer | None:
    """List guidewires and catheters: diameters, bending and torsional stiffness EI and GJ, tip load, tip shape.

    A device is shipped, or a YAML file in ~/.config/endopilot/devices or in the folder that ENDOPILOT_DEVICES names; it
    is called by its file's name.

    Args:
        devices: names of devices or paths of wires' YAML files; all known devices by default.
        tip_load: simulate the tip-load test instead; exit code 1 if a device's error exceeds the bar. π²EI/4L² is its
            load where EI is constant over the first 10 mm.
        yaml: print the file of one device or catheter instead, to start one of your own from.
    """
    if yaml:
        if len(devices) != 1:
            raise InputError(f"--yaml: {len(devices)} devices; name the one to print")
        (name,) = devices
        _row(name)  # refuses a damaged file
        print(catheter_yaml(name) if name in list_catheters() else device_yaml(name)[1], end="")
        return None
    from endopilot.simulation.tip_load import tip_load_row

    names = devices or (*list_wires(), *user_devices(), *(() if tip_load else list_catheters()))
    rows = [tip_load_row(read_wire(name)) if tip_load else _row(name) for name in names]
    tables = ([row for row in rows if ("inner_diameter_mm" in row) is bored] for bored in (False, True))
    return Answer(rows, list(filter(None, tables)), passed=all(row.get("passed") is not False for row in rows))


def _row(name: str) -> dict[str, Any]:
    if name in list_catheters():
        return read_catheter(name).summary()
    return read_wire(name).summary() | {"origin": "endopilot" if name in list_wires() else str(device_file(name))}


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
