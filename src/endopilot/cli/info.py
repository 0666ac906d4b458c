"""`endopilot info`: what a bug report needs."""

from __future__ import annotations

from endopilot import _core
from endopilot.cli.arguments import show
from endopilot.files import manifest


def command(*, json: bool = False) -> None:
    """Print the versions, the machine, and the level of instructions that the rod core uses on it.

    Args:
        json: print JSON.
    """
    facts = manifest(config=None)
    show({"commit": facts["commit"], **facts["versions"], **facts["machine"], "core": _core.LEVEL}, as_json=json)
