"""`endopilot info`: what a bug report needs."""

from __future__ import annotations

from endopilot.cli.arguments import show
from endopilot.files import manifest


def command(*, json: bool = False) -> None:
    """Print the versions and the machine that endopilot runs on.

    Args:
        json: print JSON.
    """
    facts = manifest(config=None)
    show({"commit": facts["commit"], **facts["versions"], **facts["machine"]}, as_json=json)
