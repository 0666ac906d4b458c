"""`endopilot devices`: the guidewires that endopilot knows."""

from __future__ import annotations

from endopilot.cli.arguments import show_rows
from endopilot.simulation.device import list_devices, read_device


def command(*, json: bool = False) -> None:
    """List the shipped devices.

    Args:
        json: print the rows as JSON.
    """
    show_rows([read_device(name).summary() for name in list_devices()], as_json=json)
