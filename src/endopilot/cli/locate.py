"""`endopilot locate`: vessel and lines in X-ray images -> the tip in three dimensions, frame by frame."""

from __future__ import annotations

from statistics import median

from tyro.conf import Positional

from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Existing, Figures, OutputFile, Picture
from endopilot.errors import InputError
from endopilot.xray.camera import read_camera
from endopilot.xray.frames import read_frames, write_locations
from endopilot.xray.locate import locate
from endopilot.xray.tip_filter import LocateConfig


def command(
    anatomy: Positional[Existing],
    lines: Positional[Existing],
    /,
    *,
    camera: tuple[Existing, ...],
    output: OutputFile,
    picture: Picture | None = None,
    config: LocateConfig = LocateConfig(),
) -> Figures:
    """Find the tip of a device in a vessel tree, from its lines, or tip, in the images of one view or two.

    The patient need not be registered, and breathes: the tip is followed through the frames.

    Args:
        anatomy: folder made by `endopilot anatomy` or `endopilot atlas`; or a mask, a surface or centerlines, as
            `endopilot anatomy` takes them.
        lines: CSV file with a row for each point of a line, from the tip backwards: frame, view (1 or 2), column_px,
            row_px.
        camera: YAML file of the C-arm or camera of each view.
        output: CSV file of the tips.
        picture: PNG of some frames.
        config: what is known of patient and device before the first frame.
    """
    if not 1 <= len(camera) <= 2:
        raise InputError(f"--camera: {len(camera)} files; give one for each view, one or two")
    cameras = [read_camera(path) for path in camera]
    frames = read_frames(lines, views=len(cameras))
    vessel = read_anatomy(anatomy) if (anatomy / "anatomy.json").exists() else extract_anatomy(anatomy)
    found = locate(vessel, frames=frames, cameras=cameras, config=config)
    write_locations(found, output=output)
    if picture is not None:
        from endopilot.xray.locate_picture import draw_locations  # matplotlib is slow to import

        draw_locations(vessel, found, picture, frames=frames, cameras=cameras)
    count = {status: sum(one.status == status for one in found) for status in ("found", "ambiguous", "not found")}
    residuals = [one.residual_mm for one in found if one.residual_mm == one.residual_mm]
    return {
        "tips": output,
        "frames": len(found),
        **{status.replace(" ", "_"): number for status, number in count.items()},
        "residual_median_mm": round(median(residuals), 2) if residuals else None,
        **({} if picture is None else {"picture": picture}),
    }
