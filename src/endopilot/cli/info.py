"""`endopilot info`: versions and machine, for a bug report."""

from __future__ import annotations

from endopilot import _core
from endopilot.cli.arguments import show
from endopilot.extras import extras_present
from endopilot.files import manifest


def command(*, json: bool = False) -> None:
    """Print versions, machine, the level of the rod core for this processor, and which extras are installed.

    Args:
        json: print JSON.
    """
    facts = manifest(config=None)
    figures = {"commit": facts["commit"], **facts["versions"], **facts["machine"], "core": _core.LEVEL}
    show(figures | {"extras": extras_present()}, as_json=json)
