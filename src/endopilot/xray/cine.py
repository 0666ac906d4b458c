"""X-ray images of one's own: DICOM XA cines, or PNG with the file of a C-arm, as `read_cine` reads them.

**Light.** What images hold is brought to the logarithm of the light by one rule. A linear file's (LIN) values are the
light. All others are taken for its logarithm, as monitors show it: the window that the file names, or all values that
its pixels can hold, spans 1.8 powers of e (`ImageConfig.window`), and brighter is more light, but in MONOCHROME1. The
true scale of a processed image is not known; registration finds the contrast's strength, and `photons` the noise, by
the image itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_laplace

from endopilot.errors import InputError
from endopilot.files import regular
from endopilot.xray.camera import CArmCamera, read_camera
from endopilot.xray.carm import CArmGeometry, Image, Vector, View, view_at
from endopilot.xray.image import ImageConfig

_TAGS = {
    "PositionerPrimaryAngle": "0018,1510",
    "PositionerSecondaryAngle": "0018,1511",
    "DistanceSourceToDetector": "0018,1110",
    "DistanceSourceToPatient": "0018,1111",
    "ImagerPixelSpacing": "0018,1164",
}
"""What geometry needs (PS3.3 C.8.7.5 and C.8.19.6.9): angles, LAO and cranial positive, degrees, and lengths, mm."""
_WHITE = 0.296
"""Standard deviation of noise of 1 a pixel, blurred by a scintillator of 0.16 mm on pixels of 0.308 mm, after the
Laplacian of a Gaussian of 1 pixel: computed."""
_LIT, _PENUMBRA_MM = 0.5, 2.0
"""Rows and columns with less of the usual fine structure lie behind the collimator, whose edges are blurred by up to
this on the detector, mm: 0.8 mm of focal spot, magnified by up to 4 (two standard deviations)."""
_DARKEST = 1e-3
"""Light below this share of the usual one is taken for this share: its logarithm is finite."""


@dataclass(frozen=True, eq=False)
class XrayCine:
    """The frames of one plane.

    Attributes:
        path: the file, or the first of them.
        signals: logarithm of the light over the usual one, frames of as many rows as columns.
        times_s: of the frames, from 0.
        camera: the C-arm as the tags or its file have it, about an isocenter at 0; the beam's middle is the image's.
        notes: what was assumed, or changed.
    """

    path: Path
    signals: Float32[np.ndarray, "frames rows rows"]
    times_s: Float[np.ndarray, "frames"]
    camera: CArmCamera
    notes: tuple[str, ...]

    def view(self, isocenter: Vector) -> View:
        """Return source and detector, if the C-arm turns about this point, LPS mm; a matrix says it by itself."""
        if self.camera.matrix is not None:
            return self.camera.view
        assert self.camera.angles_deg is not None
        return view_at(self.camera.angles_deg, isocenter, self.camera.geometry)

    @property
    def image(self) -> ImageConfig:
        """Detector and beam as far as they are known."""
        return ImageConfig(geometry=self.camera.geometry, pixels=self.signals.shape[1])

    def field(self) -> Bool[np.ndarray, "rows rows"]:
        """Return which pixels show something: none behind the collimator or in its edges."""
        middle, inset = self.signals[len(self.signals) // 2], int(np.ceil(_PENUMBRA_MM / self.camera.geometry.pixel_mm))
        fine = np.sqrt(np.abs(np.diff(middle, axis=0)[:, 1:] * np.diff(middle, axis=1)[1:]))
        lit = np.zeros(middle.shape, dtype=bool)
        sides = [np.flatnonzero(line > _LIT * np.median(line)) for line in (fine.mean(axis=1), fine.mean(axis=0))]
        (top, bottom), (left, right) = [(side[0] + inset, side[-1] - inset) if len(side) else (0, 0) for side in sides]
        lit[top : bottom + 1, left : right + 1] = True
        return lit

    def photons(self) -> float:
        """Return how many photons a pixel of usual brightness would count to be as noisy as these images: fine
        structure is noise but for a small share of the pixels, so that the median tells its size."""
        middle = self.signals[len(self.signals) // 2]
        fine = np.abs(gaussian_laplace(middle, 1.0)) * np.exp(0.5 * middle)
        return float((0.6745 * _WHITE / max(float(np.median(fine)), 1e-6)) ** 2)


def read_cine(paths: tuple[Path, ...] | Path, *, c_arm: Path | None = None) -> XrayCine:
    """Read the frames of one plane: a DICOM file of an X-ray angiographic image, of one frame or more, or PNG images in
    the order of time. A YAML file of the C-arm (`CArmCamera`) takes the place of tags; PNG needs one. Raises
    InputError, which names the file, what lacks in it and the mend."""
    paths = (paths,) if isinstance(paths, Path) else paths
    path, camera, notes = regular(paths[0]), None, list[str]()
    if c_arm is not None:
        given = read_camera(c_arm)
        if not isinstance(given, CArmCamera):
            raise InputError(f"{c_arm}: is a camera above a plane; give a C-arm: angles_deg and geometry, or a matrix")
        camera = given
    if path.suffix.lower() == ".png":
        if camera is None:
            raise InputError(f"{path}: a PNG says nothing of the C-arm; give its file, --camera c-arm.yaml")
        light = np.stack([_png(one) for one in paths])
        times_s = np.arange(len(paths)) * 1.0
        notes.append("PNG images are taken to be 1 s apart")
    else:
        if len(paths) > 1:
            raise InputError(f"{paths[1]}: is a second file of one plane; give one DICOM file for each plane")
        header = _header(path)
        light = _light(header, path, notes)
        camera = camera or _camera(header, path, light.shape, notes)
        light = _upright(header, light, camera, notes)
        times_s = _times(header, path, len(light), notes)
    light, camera = _squared(light, camera, notes)
    return XrayCine(path, light - np.float32(np.median(light)), times_s, camera, tuple(notes))


def _png(path: Path) -> Image:
    from PIL import Image, UnidentifiedImageError  # slow to import

    try:
        with Image.open(regular(path)) as image:
            deep = image.mode.startswith("I")
            values = np.asarray(image if deep else image.convert("L"), dtype=np.float32)
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no PNG image; give one of 8 or 16 bits") from error
    return _windowed(values, 65535.0 / 2 if deep else 127.5, 65535.0 if deep else 255.0)


def _windowed(values: np.ndarray, centre: float, width: float) -> np.ndarray:
    """Return the logarithm of the light of what a monitor shows by a window."""
    return ((values - centre) / (width / 2) * ImageConfig().window).astype(np.float32)


def _header(path: Path) -> Any:
    """Return a DICOM file that holds an X-ray image; InputError if it does not."""
    import pydicom
    from pydicom.errors import InvalidDicomError

    try:
        header = pydicom.dcmread(path)
    except InvalidDicomError as error:
        raise InputError(f"{path}: is neither DICOM nor PNG; give a cine of X-ray images (XA)") from error
    except OSError as error:
        raise InputError(f"{path}: {(error.strerror or str(error)).lower()}; check the path") from error
    if header.get("Modality") not in ("XA", "RF", None, ""):
        raise InputError(f"{path}: Modality (0008,0060) = {header.Modality}; give X-ray images, XA or RF")
    if "PixelData" not in header:
        raise InputError(f"{path}: PixelData (7FE0,0010): missing; give a file with frames")
    for name, tag in (("PositionerMotion", "0018,1500"), ("TableMotion", "0018,1134")):
        if header.get(name) == "DYNAMIC":
            raise InputError(f"{path}: {name} ({tag}) = DYNAMIC; give a cine in which C-arm and table stand still")
    return header


def _light(header: Any, path: Path, notes: list[str]) -> Float32[np.ndarray, "frames rows columns"]:
    """Return the logarithm of the light of all frames by the rule of this module, and note what was assumed."""
    try:
        values = header.pixel_array
    except Exception:  # compressions that pydicom alone does not know; GDCM does
        import SimpleITK as sitk

        try:
            values = sitk.GetArrayFromImage(sitk.ReadImage(path))
        except RuntimeError as error:
            raise InputError(f"{path}: its pixels cannot be decoded; save it without compression") from error
    if header.get("SamplesPerPixel", 1) > 1:
        values = values[..., :3].mean(axis=-1)
    values = values.reshape(-1, header.Rows, header.Columns).astype(np.float32)
    values = values * float(header.get("RescaleSlope") or 1) + float(header.get("RescaleIntercept") or 0)
    relationship = header.get("PixelIntensityRelationship") or "DISP"
    if relationship == "LIN":
        values = np.log(np.maximum(values, _DARKEST * np.median(values[values > 0])))
        return -values if header.get("PixelIntensityRelationshipSign") == -1 else values
    bits = float(2 ** header.get("BitsStored", 8) - 1)
    window = header.get("WindowCenter") or bits / 2, header.get("WindowWidth") or bits
    light = _windowed(values, *(float(np.ravel(each)[0]) for each in window))
    notes.append(f"values are taken for the logarithm of the light ({relationship}): the window spans 1.8 powers of e")
    return -light if header.get("PhotometricInterpretation") == "MONOCHROME1" else light


def _camera(header: Any, path: Path, shape: tuple[int, ...], notes: list[str]) -> CArmCamera:
    """Return the C-arm of a file's tags, about an isocenter at 0; InputError for a tag that lacks or makes no sense."""
    found = {}
    for name, tag in _TAGS.items():
        value = header.get(name)
        if value is None or value == "":
            if name == "DistanceSourceToPatient" and (factor := header.get("EstimatedRadiographicMagnificationFactor")):
                value = float(header.DistanceSourceToDetector) / float(factor)
                notes.append(f"{name} ({tag}) is not there; by the magnification factor it is {value:.0f} mm")
            else:
                raise InputError(f"{path}: {name} ({tag}): missing; give the C-arm's file, --camera c-arm.yaml")
        found[name] = np.ravel(value).astype(float)
    spacing = found["ImagerPixelSpacing"]
    if np.ptp(spacing) > 1e-3 * spacing[0]:
        raise InputError(f"{path}: ImagerPixelSpacing (0018,1164) = {spacing.tolist()}; give an image of square pixels")
    first, second, detector, patient = (float(found[name][0]) for name in list(_TAGS)[:4])
    try:
        geometry = CArmGeometry(
            source_to_isocenter_mm=patient, source_to_detector_mm=detector, pixel_mm=float(spacing[0])
        )
    except ValueError as error:
        raise InputError(f"{path}: {str(error).splitlines()[0]}") from error
    middle = ((shape[2] - 1) / 2, (shape[1] - 1) / 2)
    return CArmCamera(angles_deg=(first, second), isocenter_mm=(0.0, 0.0, 0.0), centre_px=middle, geometry=geometry)


def _upright(header: Any, light: np.ndarray, camera: CArmCamera, notes: list[str]) -> np.ndarray:
    """Return frames as the C-arm sees them, from the source's side: PatientOrientation says if they are mirrored."""
    right, up, _ = camera.view.axes
    sides = (right, 2, "left to right"), (-up, 1, "top to bottom")
    for word, (along, image_axis, name) in zip(header.get("PatientOrientation") or (), sides, strict=False):
        letter = "LRPAHF".find((word or "?")[0])
        if letter >= 0 and (-1) ** letter * along[letter // 2] < -0.1:
            light = np.flip(light, image_axis)
            notes.append(f"PatientOrientation (0020,0020) says that the image is mirrored {name}; it was turned back")
    return light


def _times(header: Any, path: Path, count: int, notes: list[str]) -> Float[np.ndarray, "frames"]:
    """Return the times of the frames, s; InputError for times of another number of frames."""
    if vector := header.get("FrameTimeVector"):
        steps = np.ravel(vector).astype(float)
        if len(steps) != count:
            raise InputError(
                f"{path}: FrameTimeVector (0018,1065): {len(steps)} times of {count} frames; mend the file"
            )
        return np.cumsum(steps) / 1000
    if step := header.get("FrameTime"):
        return np.arange(count) * float(step) / 1000
    for name in ("CineRate", "RecommendedDisplayFrameRate"):
        if rate := header.get(name):
            notes.append(f"FrameTime (0018,1063) is not there; by {name}: {rate} a second")
            return np.arange(count) / float(rate)
    if count > 1:
        notes.append("FrameTime (0018,1063) is not there; 15 frames a second are assumed")
    return np.arange(count) / 15.0


def _squared(light: np.ndarray, camera: CArmCamera, notes: list[str]) -> tuple[np.ndarray, CArmCamera]:
    """Return frames padded so that they are square about the middle of the beam."""
    rows, columns = light.shape[1:]
    column, row = camera.centre_px or ((columns - 1) / 2, (rows - 1) / 2)
    side = int(np.ceil(2 * max(column, row, columns - 1 - column, rows - 1 - row))) + 1
    before = round((side - 1) / 2 - row), round((side - 1) / 2 - column)
    around = [(0, 0), (before[0], side - rows - before[0]), (before[1], side - columns - before[1])]
    if camera.centre_px is not None:
        camera = replace(camera, centre_px=((side - 1) / 2, (side - 1) / 2))
    if side == rows == columns:
        return light, camera
    notes.append(f"{columns} × {rows} pixels were padded to {side} × {side} about the middle of the beam")
    return np.pad(light, around, mode="edge"), camera
