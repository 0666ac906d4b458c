"""Draw what a cockpit sends to 3D Slicer, with Slicer's own classes, into docs/guide/images/slicer.png.

`python docs/figures/slicer.py PATIENT NAVIGATION` replays a navigation of the guide; Slicer's libraries are those that
`python -m benchmarks judges --only slicer` keeps.
"""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from PIL import Image

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.judges.environment import environment

IMAGE = Path(__file__).parents[1] / "guide" / "images" / "slicer.png"
VIEW = Path(__file__).parents[2] / "benchmarks" / "judges" / "slicer_view.py"

if __name__ == "__main__":
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    words = [sys.executable, "-m", "endopilot.cli", "cockpit", sys.argv[1], "--replay", sys.argv[2], "--no-browser"]
    with subprocess.Popen([*words, "--igtl", port], stdout=subprocess.PIPE, encoding="utf-8") as cockpit:
        python = environment("slicer", ("slicer-core",), Path("runs/judges").resolve())
        next(line for line in cockpit.stdout or () if line.startswith("page"))
        subprocess.run([python, VIEW, port, IMAGE], check=True)
        cockpit.terminate()
    with Image.open(IMAGE) as picture:
        picture.convert("RGB").quantize(256).save(IMAGE, optimize=True)
