"""`endopilot atlas`: synthetic patients."""

from __future__ import annotations

from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_atlas
from endopilot.cli.arguments import OutputFolder, show_rows
from endopilot.progress import progress


def command(
    *,
    output: OutputFolder,
    json: bool = False,
    config: AtlasConfig = AtlasConfig(),
) -> None:
    """Make synthetic patients whose vessels match published statistics: an anatomy folder for each.

    Args:
        output: folder that takes an anatomy folder for each patient.
        json: print the figures as JSON.
        config: the patients to make.
    """
    rows = []
    with progress("Synthetic patients", config.count) as advance:
        for anatomy in make_atlas(config):
            write_anatomy(anatomy, output / anatomy.name)
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
    show_rows(rows, as_json=json)
