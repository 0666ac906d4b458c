"""A still picture of the vessel, wire and catheters in it, rendered by VTK without a screen in a process of its own.

VTK aborts its process where it finds no graphics library, so it must not run in ours: `render_still` writes what is to
be seen to a file and starts this module as a program, whose failure is then one clear line.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import Device
from endopilot.files import writing
from endopilot.plotting import CATHETER_COLORS
from endopilot.report.wall_mesh import wall_mesh
from endopilot.types import Anatomy

LIBRARIES_MISSING = (
    "the still 3-D picture is left out: VTK finds no graphics library; "
    "`apt-get install libegl1 libgl1-mesa-dri` (or libosmesa6) and run the same command again"
)
SIZE = (1600, 1000)
TIMEOUT_S = 180
_CATHETER_OPACITY = 0.45


def render_still(
    anatomy: Anatomy, lines: Sequence[Float[np.ndarray, "_ 3"]], path: Path, *, devices: Sequence[Device] = ()
) -> str | None:
    """Render the vessel's translucent wall, its centerline, the wire and translucent catheters to a PNG.

    Args:
        anatomy: the vessel.
        lines: nodes of the wire, then of each catheter, from its tip backwards, LPS mm; none to show the vessel alone.
        path: where the picture goes.
        devices: wire and catheters, which are drawn as wide as each other's diameters; needed with catheters.

    Returns:
        None when the picture is there; otherwise one line that says what to install.
    """
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
        )
        command = [sys.executable, "-m", "endopilot.report.still", str(scene), str(picture)]
        try:
            rendered = subprocess.run(command, capture_output=True, timeout=TIMEOUT_S, check=False).returncode == 0
        except subprocess.TimeoutExpired:
            rendered = False
        if not rendered or not picture.exists():
            return LIBRARIES_MISSING
        with writing(Path(path)) as partial:
            shutil.copyfile(picture, partial)
    return None


def _render(scene: Path, path: Path) -> None:
    """Draw the scene; runs in the child process."""
    import pyvista as pv

    with np.load(scene, allow_pickle=False) as file:
        arrays = dict(file.items())
    plotter: Any = pv.Plotter(off_screen=True, window_size=list(SIZE), lighting="three lights")
    plotter.set_background("#0a1120", top="#1f3155")
    wall: Any = pv.PolyData.from_regular_faces(arrays["vertices"], arrays["triangles"]).smooth_taubin(n_iter=30)
    size = float(np.linalg.norm(np.ptp(arrays["vertices"], axis=0)))
    look = {"smooth_shading": True, "specular": 0.9, "specular_power": 30, "ambient": 0.18, "diffuse": 0.9}
    plotter.add_mesh(wall, color="#e2595e", opacity=0.30, **look)
    for line in np.split(arrays["centerline"], np.cumsum(arrays["centerline_lengths"])[:-1]):
        plotter.add_mesh(pv.lines_from_points(line), color="#ffc9b8", line_width=1.5, opacity=0.55)
    lines = np.split(arrays["devices"], np.cumsum(arrays["device_lengths"]))[:-1]
    for k, (line, width) in enumerate(zip(lines, arrays["device_widths"], strict=True)):
        if len(line) < 2:
            continue
        # Drawn thicker than it is, or it would not show at this scale.
        tube: Any = pv.Spline(line, 4 * len(line)).tube(radius=0.0017 * size * width)
        seen = {"color": CATHETER_COLORS[k - 1], "opacity": _CATHETER_OPACITY} if k else {"color": "white"}
        plotter.add_mesh(tube, ambient=0.65, smooth_shading=True, **seen)
        if k == 0:
            tip = pv.Sphere(radius=0.005 * size, center=line[0])
            plotter.add_mesh(tip, color="#ffd34d", ambient=0.5, smooth_shading=True)
    plotter.enable_depth_peeling(8)
    plotter.enable_anti_aliasing("ssaa")
    # From the front, a little from the left and above, as from someone who stands before the patient.
    centre = np.mean([arrays["vertices"].min(axis=0), arrays["vertices"].max(axis=0)], axis=0)
    plotter.camera_position = [centre + np.array([0.35, -1.0, 0.22]) * size, centre, (0.0, 0.0, 1.0)]
    plotter.reset_camera()
    plotter.camera.zoom(0.94 / _filled(plotter.camera, np.concatenate([arrays["vertices"], arrays["devices"]])))
    plotter.screenshot(str(path))
    plotter.close()


def _filled(camera: Any, points: Float[np.ndarray, "n 3"]) -> float:
    """Return the share of half the picture's height or width that the farthest of some points takes up."""
    place, focus = np.array(camera.position), np.array(camera.focal_point)
    forward = (focus - place) / np.linalg.norm(focus - place)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    offset = points - place
    depth = offset @ forward
    height = np.abs(offset @ np.cross(right, forward)) / depth
    width = np.abs(offset @ right) / depth * SIZE[1] / SIZE[0]
    return float(max(height.max(), width.max())) / np.tan(np.radians(camera.view_angle) / 2)


if __name__ == "__main__":
    _render(Path(sys.argv[1]), Path(sys.argv[2]))
