"""`endopilot sample`: download a real CT angiogram to try."""

from __future__ import annotations

from typing import Literal

from tyro.conf import Positional

from endopilot.imaging.sample import fetch_sample


def sample_command(name: Positional[Literal["cta-thorax"]] = "cta-thorax", /) -> None:
    """Download a real thoracic CT angiogram, check it, and print its path, licence and source.

    Args:
        name: which sample.
    """
    print(fetch_sample(name))
