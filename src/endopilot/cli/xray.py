"""`endopilot xray`, `locate` and `angiograms`: X-ray images of devices in vessels, and devices found in them."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from endopilot.anatomy.extract import extract_anatomy
from endopilot.anatomy.io import read_anatomy
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.cli.arguments import Figures
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.volume import read_volume
from endopilot.runs import Existing, OutputFolder, Page, Picture, Table
from endopilot.types import Anatomy
from endopilot.xray.camera import read_camera
from endopilot.xray.frames import draw_locations, read_frames, write_locations, write_page
from endopilot.xray.take_image import TakeImageConfig, take_image
from endopilot.xray.tip_filter import LocateConfig, TipLocation, locate


def xray_command(
    anatomy: Existing,
    /,
    *,
    output: Picture,
    ct: Existing | None = None,
    config: TakeImageConfig = TakeImageConfig(),
) -> Figures:
    """Push a wire, alone or in a catheter, into a vessel, and take an X-ray image: fluoroscopy, contrast, DSA, roadmap.

    Args:
        output: the image, .png.
        ct: CT angiogram of the patient, HU; a synthetic chest around a coronary artery, else water, if not given.
    """
    volume = None if ct is None else read_volume(ct)
    image = take_image(read_anatomy(anatomy), config=config, ct=volume)
    image.write(output)
    tip = None if image.tip_pixel is None else [round(float(value), 2) for value in image.tip_pixel]
    figures = {"image": output, "tip_row_column": tip, "mm_per_pixel": round(image.mm_per_pixel, 4)}
    if volume is not None and volume.notes:
        figures["ct_notes"] = list(volume.notes)
    return figures | {"frames": image.frames, "air_kerma_ugy": round(image.air_kerma_ugy, 3)}


def angiograms_command(
    patients: tuple[Existing, ...],
    /,
    *,
    output: OutputFolder,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    scheduler: str | None = None,
    config: AngiogramsConfig = AngiogramsConfig(),
) -> Figures:
    """Make X-ray cines of patients' vessels, with contrast, motion and devices, and the truth of each frame.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        patients: folders made by `endopilot anatomy` or `endopilot atlas`, or CT angiograms, which are segmented.
        output: folder of the data set.
    """
    from endopilot.angiograms.config import MANIFEST_FILE, SAMPLES_FILE  # slow to import; --help needs none
    from endopilot.angiograms.make import make_angiograms

    make_angiograms(patients, output=output, device=Stack.of(device, *catheter), config=config, scheduler=scheduler)
    splits = read_json(output / MANIFEST_FILE)["splits"]
    return {
        "data_set": output,
        **{f"{split}_{what}": count for split, counts in splits.items() for what, count in counts.items()},
        "samples": output / SAMPLES_FILE,
    }


def locate_command(
    anatomy: Existing,
    seen: tuple[Existing, ...],
    /,
    *,
    camera: tuple[Existing, ...] = (),
    output: Table,
    picture: Picture | None = None,
    page: Page | None = None,
    device: str = "workhorse-014",
    config: LocateConfig = LocateConfig(),
) -> Figures:
    """Find the tip of a device in a vessel tree, in X-ray images of one view or two, or from its lines in them.

    Images register the patient by their contrast, or by a landmark; to lines the patient need not be registered. The
    tip is followed through the frames, and the vessel as heart and breath move it.

    Args:
        anatomy: folder made by `endopilot anatomy` or `endopilot atlas`; or a mask, a surface or centerlines, as
            `endopilot anatomy` takes them.
        seen: an X-ray cine (DICOM XA), or two of planes exposed together; PNG images of one plane in the order of time;
            or a CSV file of lines with a row for each point, from the tip backwards: frame, view (1 or 2), column_px,
            row_px.
        camera: YAML file of the C-arm or camera of each view; for a cine, in place of what its tags say.
        output: CSV file of the tips.
        picture: PNG of some frames.
        page: HTML page of what was found.
        device: name of the wire (`endopilot devices`) or a YAML file, for images.
    """
    vessel = read_anatomy(anatomy) if (anatomy / "anatomy.json").exists() else extract_anatomy(anatomy)
    find = _in_lines if seen[0].suffix.lower() == ".csv" else _in_images
    found, drawn, figures, said = find(vessel, seen, camera, device, config)
    write_locations(found, output=output)
    count = {status: sum(one.status == status for one in found) for status in ("found", "ambiguous", "not found")}
    counted = ", ".join(f"{number} {status}" for status, number in count.items())
    if picture is not None or page is not None:
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "frames.png" if picture is None else picture
            draw_locations(vessel, found, path, **drawn)
            if page is not None:
                title = f"{vessel.name}: tips in {', '.join(one.name for one in seen)}"
                write_page(page, title=title, said=[*said, counted], picture=path)
    return {
        "tips": output,
        "frames": len(found),
        **{status.replace(" ", "_"): number for status, number in count.items()},
        **figures,
        **({} if picture is None else {"picture": picture}),
        **({} if page is None else {"page": page}),
    }


_Found = tuple[Sequence[TipLocation], dict[str, Any], dict[str, Any], Sequence[str]]
"""Tips, what is drawn, figures, and what is said of them."""


def _in_lines(
    vessel: Anatomy, seen: tuple[Path, ...], camera: tuple[Path, ...], device: str, config: LocateConfig
) -> _Found:
    if not (len(seen) == 1 and 1 <= len(camera) <= 2):
        raise InputError(f"--camera: {len(camera)} files for {len(seen)} of lines; give one for each view, one or two")
    cameras = [read_camera(path) for path in camera]
    lines = next(iter(seen))
    frames = read_frames(lines, views=len(cameras))
    found = locate(vessel, frames=frames, cameras=cameras, config=config)
    residuals = [one.residual_mm for one in found if one.residual_mm == one.residual_mm]
    drawn = {
        "lines": [frame.lines[0] for frame in frames],
        "project": lambda index, points: cameras[0].project(points + found[index].moved_mm),
    }
    return found, drawn, {"residual_median_mm": round(median(residuals), 2) if residuals else None}, ()


def _in_images(
    vessel: Anatomy, seen: tuple[Path, ...], camera: tuple[Path, ...], device: str, config: LocateConfig
) -> _Found:
    from endopilot.xray.cine import read_cine  # pydicom is slow to import
    from endopilot.xray.locate_images import locate_in_images

    planes = [seen] if seen[0].suffix.lower() == ".png" else [(one,) for one in seen]
    if len(planes) > 2:
        raise InputError(f"{seen[2]}: is a third cine; give one, or two of planes that were exposed together")
    if len(camera) not in (0, len(planes)):
        raise InputError(f"--camera: {len(camera)} files for {len(planes)} planes; give one for each")
    cines = [read_cine(paths, c_arm=camera[k] if len(camera) else None) for k, paths in enumerate(planes)]
    found = locate_in_images(vessel, cines=cines, device=Stack.of(device).wire, config=config)
    drawn = {
        "lines": [None if wire is None else found.pixels(frame, wire[::-1]) for frame, wire in enumerate(found.wires)],
        "project": found.pixels,
        "images": found.cines[0].signals,
    }
    registered = found.registration
    figures = {
        "registered": "by landmark" if registered is None else f"by contrast, frame {found.best}",
        "agreement": None if registered is None else round(registered.correlation, 3),
        "notes": list(found.notes),
    }
    said = [f"registered {figures['registered']}; image and vessel agree by {figures['agreement']}", *found.notes]
    return found.tips, drawn, figures, said
