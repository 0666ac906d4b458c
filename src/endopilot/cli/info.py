"""`endopilot info`: versions and machine, for a bug report."""

from __future__ import annotations

from endopilot import _core
from endopilot.cli.arguments import Figures
from endopilot.extras import extras_present
from endopilot.files import manifest


def info_command() -> Figures:
    """Print versions, machine, the level of the rod core for this processor, and which extras are installed."""
    facts = manifest(config=None)
    figures = {"commit": facts["commit"], **facts["versions"], **facts["machine"], "core": _core.LEVEL}
    there = extras_present()
    return figures | {
        name: " ".join(e for e in there if there[e] is is_there) or "-"
        for name, is_there in (("extras", True), ("missing", False))
    }
