"""A still picture of the vessel, wire and catheters in it, by VTK in a process of its own, `still_process`: VTK aborts
where it finds no graphics library, and its failure is then one clear line."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.wall_mesh import wall_mesh
from endopilot.devices.device import Device
from endopilot.files import writing
from endopilot.plotting import CATHETER_COLORS
from endopilot.report import still_process
from endopilot.types import Anatomy

LIBRARIES_MISSING = (
    "the still 3-D picture is left out: VTK finds no graphics library; "
    "`apt-get install libegl1 libgl1-mesa-dri` (or libosmesa6) and run the same command again"
)
TIMEOUT_S = 180


def render_still(
    anatomy: Anatomy, lines: Sequence[Float[np.ndarray, "_ 3"]], path: Path, *, devices: Sequence[Device] = ()
) -> str | None:
    """Render the vessel's wall, its centerline, and `lines` (nodes of the wire, then of each catheter, from the tip,
    LPS mm) to a PNG; return None, or a line that says what to install."""
    surface = wall_mesh(anatomy.distance_map, max_triangles=400_000)
    centerlines = [branch.centerline.points for branch in anatomy.tree.branches]
    widths = [device.diameter_mm / devices[0].diameter_mm for device in devices] or [1.0] * len(lines)
    with tempfile.TemporaryDirectory() as folder:
        scene, picture = Path(folder) / "scene.npz", Path(folder) / "picture.png"
        np.savez(
            scene,
            vertices=surface.vertices,
            triangles=surface.triangles,
            centerline=np.concatenate(centerlines),
            centerline_lengths=np.array([len(line) for line in centerlines]),
            devices=np.concatenate([np.empty((0, 3)), *lines]),
            device_lengths=np.array([len(line) for line in lines], dtype=int),
            device_widths=np.array(widths),
            catheter_colors=np.array(CATHETER_COLORS),
        )
        command = [sys.executable, "-P", still_process.__file__, str(scene), str(picture)]
        try:
            rendered = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S, check=False).returncode == 0
        except subprocess.TimeoutExpired:
            rendered = False
        if not rendered or not picture.exists():
            return LIBRARIES_MISSING
        with writing(Path(path)) as partial:
            shutil.copyfile(picture, partial)
    return None
