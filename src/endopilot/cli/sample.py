"""`endopilot sample`: fetch a real CT angiogram to try."""

from __future__ import annotations

from typing import Literal

from tyro.conf import Positional

from endopilot.imaging.sample import fetch_sample


def command(name: Positional[Literal["cta-thorax"]] = "cta-thorax", /) -> None:
    """Fetch a real thoracic CT angiogram, check it, and print where it lies, its licence and its source.

    Args:
        name: which sample.
    """
    print(fetch_sample(name))
