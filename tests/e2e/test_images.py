"""Images at the command line: synthetic CT as DICOM, bad ones, and none of a patient's identifiers in any output."""

from __future__ import annotations

import gzip
import logging
import re
import warnings
import zlib
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.datadict import DicomDictionary
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

from command import refused, run
from endopilot.anatomy.io import read_anatomy
from endopilot.imaging.volume import read_mask, write_volume
from endopilot.types import Volume


def test_a_straightened_ct_is_told_by_every_command(patient, tmp_path, capsys, monkeypatch):
    """The mask lies on straightened axes: its anatomy tells it too, from the file beside the mask."""
    from endopilot.pipeline import study

    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    _, j, i = np.indices((40, 40, 40))
    hu = np.where(np.hypot(j - 20, i - 20) < 7, 350, -90).astype(np.int16)
    skewed = tmp_path / "ct"
    write_volume(Volume(hu, np.full(3, 2.0), np.array([-25.0, -45.0, -72.0]), np.eye(3)), skewed)
    for file in skewed.iterdir():
        slice_ = pydicom.dcmread(file)
        slice_.ImageOrientationPatient = ["1", "0", "0", "0.002", "0.999998", "0"]
        slice_.save_as(file)
    seed = ("15", "-5", "0")
    method = ("--method", "my_segmentation:threshold", "--options", "above=200", "--seeds", *seed)
    note = "ct: the axes in ImageOrientationPatient and ImagePositionPatient are off unit vectors"
    figures = run(capsys, "segment", skewed, "-o", tmp_path / "mask.nii.gz", *method)
    assert figures["warnings"][0].startswith(note)
    assert read_mask(tmp_path / "mask.nii.gz").warnings[0].startswith(note)
    image = run(capsys, "xray", patient, "-o", tmp_path / "image.png", "--ct", skewed, "--inserted-length-mm", "10")
    assert image["ct_notes"][0].startswith(note)
    monkeypatch.setattr(study, "_study", lambda run, anatomies: {"notes": list(run.notes)})
    figures = run(capsys, "run", skewed, "-o", tmp_path / "run", *method)
    assert figures["notes"][0].startswith(note)
    assert read_mask(tmp_path / "run" / "masks" / "patient.nii.gz").warnings[0].startswith(note)
    assert read_anatomy(tmp_path / "run" / "anatomies" / "patient").provenance["notes"][1].startswith(note)


_MARKED = {
    "PN": "Zq7Dœ^Zq7Jürgen",
    "LO": "Zq7 Hospital",
    "SH": "Zq7-4711",
    "ST": "Zq7 street",
    "LT": "Zq7 remarks",
    "UT": "Zq7 report",
    "UC": "Zq7 characters",
    "UR": "https://zq7.example",
    "AE": "ZQ7AE",
    "CS": "ZQ7CS",
    "DA": "19370517",
    "DT": "19370517031742",
    "TM": "031742.937",
    "IS": "73193705",
    "DS": "73.193705",
    "UI": "1.2.9999.73.193705",
}
_MARKS = re.compile(
    rb"zq7|z\0q\0007|19370517|1937-05-17|031742|03:17:42|73193705|73\.193705|1\.2\.9999\.73", re.IGNORECASE
)
_NEEDED = {
    *("SOPClassUID", "Modality", "ImageType", "SeriesNumber", "ImagePositionPatient", "ImageOrientationPatient"),
    *("RescaleSlope", "RescaleIntercept", "RescaleType", "SpecificCharacterSet", "NumberOfFrames"),
}
_SEEDS = ("--method", "aorta", "--seeds", "0", "0", "-50", "0", "0", "50")


def _identified(header: Dataset) -> None:
    """Fill a header with marks."""
    header.SpecificCharacterSet = "ISO_IR 192"
    for tag, (vr, _, _, retired, keyword) in DicomDictionary.items():
        group = tag >> 16
        if (
            vr in _MARKED
            and keyword
            and keyword not in _NEEDED
            and group not in (0x0000, 0x0002, 0x0028)
            and not retired
        ):
            header.add_new(tag, vr, _MARKED[vr])
    item = Dataset()
    item.PatientName, item.RequestedProcedureID = _MARKED["PN"], _MARKED["SH"]
    header.RequestAttributesSequence = header.OtherPatientIDsSequence = Sequence([item])
    block = header.private_block(0x0029, "ZQ7 PRIVATE", create=True)
    block.add_new(0x01, "LO", "Zq7 private")
    block.add_new(0x02, "UN", b"Zq7 unknown")


@pytest.fixture
def case(tmp_path) -> Path:
    """Return a folder of slices of a contrasted tube of 10 mm radius in muscle, their headers full of marks."""
    voxels = np.full((26, 32, 32), 40, dtype=np.int16)
    y, x = (np.mgrid[:32, :32] - 15.5) * 2.0
    voxels[:, np.hypot(x, y) < 10.0] = 400
    voxels[:, :2] = -100
    folder = tmp_path / "case"
    write_volume(Volume(voxels, np.array([2.0, 2.0, 5.0]), np.array([-31.0, -31.0, -63.0]), np.eye(3)), folder)
    made = pydicom.dcmread(next(folder.iterdir()))
    _identified(made)
    identifying = {element.keyword for element in made} - _NEEDED
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k, file in enumerate(sorted(folder.iterdir())):
            slice_ = pydicom.dcmread(file)
            for element in made:
                if element.tag not in slice_ or (element.keyword in identifying and element.tag.group < 0x28):
                    slice_[element.tag] = element
            slice_.SOPInstanceUID = slice_.file_meta.MediaStorageSOPInstanceUID = f"{_MARKED['UI']}.{k}"
            slice_.preamble = b"Zq7 preamble".ljust(128, b"\0")
            slice_.save_as(file)
    return folder


def _content(file: Path) -> bytes:
    """Return all that a file holds, packed parts unpacked."""
    content = file.read_bytes()
    if file.suffix == ".gz":
        return gzip.decompress(content)
    if file.suffix == ".nrrd":
        head, _, body = content.partition(b"\n\n")
        return head + zlib.decompress(body, wbits=47)
    if file.suffix == ".parquet":
        import pandas as pd

        return content + pd.read_parquet(file).to_csv().encode()
    return content


def test_a_header_full_of_identifiers_leaves_no_trace(case, tmp_path, capfd, caplog):
    pytest.importorskip("highdicom", reason="DICOM-SEG needs highdicom (the extra dicom-seg)")
    assert all(len(_MARKS.findall(file.read_bytes())) > 1000 for file in case.iterdir())
    out, told, said = tmp_path / "out", [], []

    def command(*arguments: str | Path) -> None:
        said.append(str(run(capfd, *arguments)))

    with warnings.catch_warnings(record=True) as warned, caplog.at_level(logging.DEBUG):
        warnings.simplefilter("always")
        command("segment", case, "-o", out / "mask.nii.gz", "--picture", out / "mask.png", *_SEEDS)
        command("segment", case / "slice-0003.dcm", "-o", out / "seg.dcm", *_SEEDS)
        command("anatomy", out / "mask.nii.gz", "-o", out / "anatomy")
        command("simulate", out / "anatomy", "-o", out / "rollout.parquet", "--sequences", "1", "--seconds", "1")
        file = sorted(case.iterdir())[5]
        content = file.read_bytes()
        for bad in (
            content[:-900],
            content.replace(b"2.0\\2.0 ", b"Zq7^Zq7 "),
            content[: len(content) // 3],
        ):
            file.write_bytes(bad)
            told.append(refused(capfd, "segment", case, "-o", out / "other.nii.gz", *_SEEDS))
    assert "truncated" in told[0] and "damaged" in told[1] and all("slice" in line for line in told)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert {"mask.nii.gz", "mask.json", "mask.png", "seg.dcm", "anatomy.json", "rollout.parquet"} <= {
        f.name for f in files
    }
    for path in files:
        assert not _MARKS.search(_content(path)), path
    for text in (*told, *said, *map(str, files), caplog.text, *(str(w.message) for w in warned), *capfd.readouterr()):
        assert not _MARKS.search(text.encode()), text
