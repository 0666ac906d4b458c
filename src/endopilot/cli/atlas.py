"""`endopilot atlas`: synthetic patients."""

from __future__ import annotations

from endopilot import __version__
from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_atlas
from endopilot.cli.arguments import Figures, OutputFolder
from endopilot.progress import progress
from endopilot.runs import claiming


def command(*, output: OutputFolder, config: AtlasConfig = AtlasConfig()) -> Figures:
    """Make synthetic patients whose vessels match published statistics: an anatomy folder for each.

    Args:
        output: folder that takes an anatomy folder for each patient.
    """
    rows = []
    with progress("Synthetic patients", config.count) as advance:
        for anatomy in make_atlas(config=config):
            identity = {"patient": anatomy.identity, "version": __version__}
            with claiming(output / anatomy.name, "endopilot atlas", **identity):
                write_anatomy(anatomy, output=output / anatomy.name)
            path = anatomy.tree.longest_path()
            rows.append(
                {
                    "patient": anatomy.name,
                    "branches": len(anatomy.tree.branches),
                    "length_mm": round(float(path.abscissa[-1]), 1),
                    "ostium_radius_mm": round(float(path.radius[0]), 2),
                }
            )
            advance()
    return rows
