"""`endopilot dataset-info`: dataset -> its content in figures and pictures."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot import __version__
from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.runs import claim


def command(dataset: Positional[Existing], /, *, output: OutputFolder | None = None) -> Figures:
    """Describe a dataset: distributions of depth, offset and force, branches, failures with their reasons.

    Args:
        dataset: folder made by `endopilot dataset`.
        output: folder of the pictures, one of each distribution; none is drawn if not given.
    """
    from endopilot.dataset.info import describe_dataset, draw_pictures  # an extra brings their libraries

    description = describe_dataset(dataset)
    if output is not None:
        claim(output, "endopilot dataset-info", figures=description.figures, version=__version__)
    pictures = [] if output is None else draw_pictures(description, output)
    return description.figures | ({"pictures": pictures} if pictures else {})
