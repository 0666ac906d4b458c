"""A real CT angiogram to try, fetched once into the user's cache: a test file in the source distribution of
TotalSegmentator (https://github.com/wasserth/TotalSegmentator, Apache-2.0)."""

from __future__ import annotations

import sys
import tarfile
import tempfile
from pathlib import Path

from endopilot.errors import InputError
from endopilot.progress import progress

_NAME = "cta-thorax"
_URL = (
    "https://files.pythonhosted.org/packages/c3/53/7d654d2ec3fcb801ae54d318b0ffc18021aed528bf4e4df0753caf0c8a73/"
    "totalsegmentator-2.18.0.tar.gz"
)
_SHA256 = "5d4223ef93973bc36d710869d11e7742ead2c154c72f7f9edcaaadd5b6c4bd03"
_ABOUT = "thoracic CT angiogram, 1.5 mm, of a dissected and stented aorta; the masks are a network's output"
_REPORT = "totalsegmentator-2.18.0/tests/reference_files/aorta_report"
_FILES = {
    "cta_thorax_1p5mm.nii.gz": (
        f"{_REPORT}/example_ct.nii.gz",
        "372d98723e3283a8d4a0ae2f0ef1e581c0ad17b673b30b2e8d3e215180cc2a12",
    ),
    "seg_aorta.nii.gz": (
        f"{_REPORT}/test_result/models/aorta.nii.gz",
        "7fa1b813c63abcbe455b62a510c5e7a00fe0998f30541d5a8af46b20a88dd7f7",
    ),
}
"""Name in the cache: place in the archive, and SHA-256. The first is the CT."""


def fetch_sample(name: str = "cta-thorax") -> Path:
    """Return the path of a sample CT, masks beside it, fetched if needed, its licence and source on standard error.
    Raises InputError if it is unknown, cannot be fetched, or is not what it should be."""
    import pooch

    if name != _NAME:
        raise InputError(f"sample {name!r} is unknown; choose one of {_NAME}")
    folder = pooch.os_cache("endopilot") / "samples" / name
    registry = {file: sha256 for file, (_, sha256) in _FILES.items()}
    cache = pooch.create(path=folder, base_url="", registry=registry, urls={f: at for f, (at, _) in _FILES.items()})
    pooch.get_logger().setLevel("WARNING")
    with tempfile.TemporaryDirectory(prefix="endopilot-") as temporary:

        def extract(place: str, file: str, _: object) -> None:
            with progress(f"Fetching {Path(place).name}", 1) as advance:
                with tarfile.open(pooch.retrieve(_URL, _SHA256, "archive", temporary)) as archive:
                    Path(file).write_bytes(archive.extractfile(place).read())  # pyright: ignore[reportOptionalMemberAccess]
                advance()

        try:
            paths = [Path(cache.fetch(file, downloader=extract)) for file in _FILES]  # pyright: ignore[reportArgumentType]
        except ValueError as error:
            raise InputError(f"{_URL}: has another SHA-256 than the sample; it is not used") from error
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise InputError(
                f"{_URL}: cannot be fetched into {folder} ({reason}); check the network and the folder"
            ) from error
    print(f"{name}: {_ABOUT}", file=sys.stderr)
    print(f"source: {_URL}; licence: Apache-2.0", file=sys.stderr)
    return paths[0]
