"""DICOM files as ITK writes them, compressed or not."""

from __future__ import annotations

import locale
from pathlib import Path

import SimpleITK as sitk


def write_dicom(image: sitk.Image, path: Path, *, compressor: str | None = None) -> None:
    """Write an image as a DICOM file under the UIDs that it has, and keep the locale, which ITK leaves at "C"."""
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    if compressor is not None:
        writer.UseCompressionOn()
        writer.SetCompressor(compressor)
    writer.SetFileName(str(path))
    before = locale.setlocale(locale.LC_ALL)
    writer.Execute(image)
    locale.setlocale(locale.LC_ALL, before)
