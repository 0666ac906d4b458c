"""The speed of an older build of endopilot on the same worlds, in a process of its own: `Baseline`.

The build is the one that today's core is compared with. `make core-baseline` makes it from the repository's history.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from endopilot.errors import InputError

BASELINE_FOLDER = Path(__file__).parents[2] / "build" / "core-baseline"
"""Where `make core-baseline` puts the build, in a checkout."""
_WORKER = Path(__file__).with_name("baseline_worker.py")


class Baseline:
    """A process that simulates the scenes with an older build, whenever it is asked to."""

    def __init__(self, folder: Path, work: Mapping[str, Any]) -> None:
        """Start the process.

        Args:
            folder: the build, as `pip install --target` leaves it.
            work: what to simulate, as `baseline_worker.py` takes it.
        """
        self._folder = folder
        # Without site, no editable installation of today's package comes before the build.
        path = os.pathsep.join([str(folder), *(entry for entry in sys.path if entry)])
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-S", str(_WORKER), str(folder), json.dumps(work)],
            env=os.environ | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def seconds(self) -> float:
        """Simulate all worlds once, on one thread, and return the processor time, s.

        Raises:
            InputError: the build does not run.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print("run", file=self._process.stdin, flush=True)
            return float(self._process.stdout.readline())
        except (OSError, ValueError):
            raise InputError(f"{self._folder}: does not run; make it anew with `make core-baseline`") from None

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()
