"""The command line: a function for each command, a thin wrapper of a stage's entry function.

Only the module of the command that is called is imported, so that `endopilot --help` and `endopilot info` are fast.
"""

from __future__ import annotations

import functools
import gc
import importlib
import os
import resource
import signal
import sys
from collections.abc import Sequence

from endopilot import __version__
from endopilot.errors import STOPPING, InputError, Stopped, stop

TYPE_CHECKING = False  # typing is slow to import: until the handlers of signals stand, Ctrl-C gives a traceback
if TYPE_CHECKING:
    from endopilot.cli.options import Command

COMMANDS = {
    "demo": "six synthetic patients -> everything from the CT angiogram to the report",
    "run": "one CT angiogram -> everything up to the report, and a wire driven to a target",
    "segment": "CT angiogram -> mask of the vessel lumen",
    "anatomy": "mask, mesh or centerline -> centerline tree, section labels, distance map",
    "atlas": "synthetic patients",
    "phantom": "anatomy -> synthetic CT angiogram",
    "simulate": "anatomy and proximal controls -> motion of the wire and its contact forces",
    "dataset": "anatomies -> many random navigations on disk",
    "dataset-info": "dataset -> its content in figures and pictures",
    "train": "dataset -> the paper's forward and inverse network",
    "evaluate": "trained run -> errors beside the paper's and the baselines'",
    "difficulty": "anatomy -> exposures and seconds that each of its sections will take, before a procedure",
    "plan": "anatomy and target -> controls that bring the tip there",
    "navigate": "anatomy and target -> a wire driven there by a policy, in closed loop, and its page",
    "xray": "anatomy -> X-ray image of a wire in it: fluoroscopy, contrast, DSA or roadmap",
    "locate": "vessel and a device's lines in X-ray images -> its tip in three dimensions, frame by frame",
    "angiograms": "anatomies or CTs -> X-ray cines of contrast and devices, with the truth beside each frame",
    "advise": "trained run -> calibrated X-ray adviser: exposures against missed events",
    "drive": "a simulated robotic drive that takes commands over TCP, with a watchdog",
    "replay": "a robot's log -> its commands in the simulator, and both tips side by side",
    "calibrate": "robot's logs -> gain, lag, plays, tip shape and friction, each with an interval",
    "cockpit": "a wire in the browser: watched, driven by hand, or left to a policy",
    "ladder": "a policy on twelve tasks in unseen patients -> scores, a page and a submission",
    "mcp": "a folder -> ten tools for assistants, with files inside it alone",
    "verify": "the rod core compared with closed forms",
    "devices": "the known guidewires and their properties",
    "sample": "download a real CT angiogram to try",
    "completion": "a script with which bash, zsh and fish complete commands and options",
    "info": "versions and machine",
}
"""Name of each command: what it takes -> what it makes."""
_TOGETHER = {
    "patients": "segment anatomy atlas phantom",
    "data": "dataset dataset-info train evaluate",
    "navigation": "difficulty plan advise",
    "xray": "xray locate angiograms",
    "robots": "replay calibrate",
    "cockpit": "cockpit drive",
    "checks": "verify devices sample completion info",
}
"""Modules of several commands that import about the same; others have a module of their own name, or are `_STAGES`."""
_STAGES = {"demo": "study:run_demo", "run": "study:run_volume", "navigate": "navigation:navigate_into"}
"""Commands that are functions of `endopilot.pipeline`: module and name."""
GROUPS = {"demo": "All stages", "segment": "Patients", "simulate": "Simulation, data, models"}
GROUPS |= {
    "difficulty": "Navigation",
    "xray": "X-ray",
    "drive": "Robots",
    "cockpit": "By hand, and scored",
    "mcp": "Assistants",
    "verify": "Checks and samples",
}
"""The heading above a group's first command in `endopilot --help`."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `endopilot` with `arguments` (those of the process by default) and leave with its exit code.

    Bad input, or an extra that is not installed, gives one line on standard error and exit code 2; Ctrl-C gives 130.
    With arguments of the process, standard output and standard error are for the command alone (`own_streams`).
    """
    is_process = arguments is None
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        for number in STOPPING if is_process else ():
            signal.signal(number, stop)
        if resource.getrlimit(resource.RLIMIT_FSIZE)[0] != resource.RLIM_INFINITY:
            sys.dont_write_bytecode = True  # Python keeps compiled modules that such a limit cuts short
        from endopilot.cli.process import carry_out, leave, own_streams  # slow to import: a signal may come before

        name = arguments[0] if arguments and arguments[0] in COMMANDS else ""
        if is_process:
            own_streams()
            gc.disable()  # until the command is imported, which leaves no garbage
        code = carry_out(name, functools.partial(_work, name, arguments))
    except Stopped as stopped:  # before the command has begun
        code = int(str(stopped.code))
        print(f"endopilot: {'interrupted' if code == 128 + signal.SIGINT else 'terminated'}", file=sys.stderr)
        os._exit(code)
    leave(code) if is_process else sys.exit(code)


def command_of(name: str) -> Command:
    """Return a command by its name."""
    from endopilot.cli.options import Command  # pydantic is slow to import

    module = next((module for module, names in _TOGETHER.items() if name in names.split()), name)
    place, _, function = _STAGES.get(name, f"{module}:{name.replace('-', '_')}_command").partition(":")
    room = "pipeline" if name in _STAGES else "cli"
    return Command(f"endopilot {name}", getattr(importlib.import_module(f"endopilot.{room}.{place}"), function))


def overview() -> str:
    """Return the text of `endopilot --help`."""
    import textwrap

    headings = {name: f"\n{group}\n" for name, group in GROUPS.items()}
    lines = {name: textwrap.fill(f"  {name:<12} {of}", 80, subsequent_indent=" " * 15) for name, of in COMMANDS.items()}
    commands = "\n".join(f"{headings.get(name, '')}{line}" for name, line in lines.items())
    return f"""usage: endopilot COMMAND ...

From a CT angiogram to an agent that drives an endovascular guidewire.
For research; no medical device.
Units are mm, N, s, rad and HU; world coordinates are LPS mm.
{commands}

`endopilot COMMAND --help` lists what is set most often, with units and
defaults; `--help-all` lists all."""


def _work(name: str, arguments: Sequence[str]) -> int:
    for word in arguments:
        if any("\ud800" <= letter <= "\udfff" for letter in word):  # so Python has bytes that are no UTF-8
            raise InputError(f"{word}: the name is not UTF-8; rename it, and give the new name")
    if name:
        from endopilot.cli.process import EXIT_FAILED, check_memory_limit

        check_memory_limit()
        command = command_of(name)
        if not gc.isenabled():
            gc.freeze()  # what is imported stays, and need not be gone through again and again
            gc.enable()
        return 0 if getattr(command.run(arguments[1:]), "passed", True) else EXIT_FAILED
    if not arguments or arguments[0] in ("-h", "--help"):
        print(overview())
    elif arguments[0] == "--version":
        print(f"endopilot {__version__}")
    else:
        import difflib

        near = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
        hint = f"did you mean '{near[0]}'?" if near else "`endopilot --help` lists the commands."
        raise InputError(f"there is no command '{arguments[0]}'; {hint}")
    return 0
