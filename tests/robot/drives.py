"""A drive as a process of its own."""

from __future__ import annotations

import contextlib
import subprocess
import sys

HOST = "127.0.0.1"
MAIN = "from endopilot.cli import main; main()"


@contextlib.contextmanager
def running(certificates, *options):
    """Start a drive on a free port, yield its process and the port, and check that no traceback was printed."""
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "drive", "--certificates", str(certificates), "--port", "0", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        begun = process.stdout.readline()
        assert begun.startswith(f"listening on {HOST}:"), process.communicate()
        yield process, int(begun.rsplit(":", 1)[1])
    finally:
        process.kill()
        _, errors = process.communicate(timeout=20)
    assert "Traceback" not in errors
