"""`endopilot dataset-info`: dataset -> its content in figures and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from endopilot.cli.arguments import existing, show


def command(
    dataset: Positional[Path],
    /,
    *,
    output: Annotated[Path | None, arg(name="output", aliases=("-o",), metavar="DIR")] = None,
    json: bool = False,
) -> None:
    """Describe a dataset: distributions of depth, offset and force, branches, failures with their reasons.

    Args:
        dataset: folder made by `endopilot dataset`.
        output: folder of the pictures, one of each distribution; none is drawn if not given.
        json: print the figures as JSON.
    """
    from endopilot.dataset.info import describe_dataset, draw_pictures  # an extra brings their libraries

    description = describe_dataset(existing(dataset))
    pictures = [] if output is None else draw_pictures(description, output)
    show(description.figures | ({"pictures": [str(path) for path in pictures]} if pictures else {}), as_json=json)
