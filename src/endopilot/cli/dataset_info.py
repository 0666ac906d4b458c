"""`endopilot dataset-info`: dataset -> its content in figures and pictures."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder


def command(
    dataset: Positional[Existing],
    /,
    *,
    output: OutputFolder | None = None,
) -> Figures:
    """Describe a dataset: distributions of depth, offset and force, branches, failures with their reasons.

    Args:
        dataset: folder made by `endopilot dataset`.
        output: folder of the pictures, one of each distribution; none is drawn if not given.
    """
    from endopilot.dataset.info import describe_dataset, draw_pictures  # an extra brings their libraries

    description = describe_dataset(dataset)
    pictures = [] if output is None else draw_pictures(description, output)
    return description.figures | ({"pictures": pictures} if pictures else {})
