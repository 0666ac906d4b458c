"""A still picture of the vessel with the wire in it, rendered by VTK without a screen, in a process of its own.

VTK aborts its process where it finds no graphics library, so it must not run in ours: `render_still` writes what is to
be seen to a file and starts this module as a program, whose failure is then one clear line.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.files import writing
from endopilot.report.wall_mesh import wall_mesh
from endopilot.types import Anatomy

LIBRARIES_MISSING = (
    "the still 3-D picture is left out: VTK finds no graphics library; "
    "`apt-get install libegl1 libgl1-mesa-dri` (or libosmesa6) and run the same command again"
)
SIZE = (1600, 1000)
TIMEOUT_S = 180


def render_still(anatomy: Anatomy, wire: Float[np.ndarray, "nodes 3"] | None, path: Path) -> str | None:
    """Render the vessel's translucent wall, its centerline and the wire to a PNG.

    Args:
        anatomy: the vessel.
        wire: nodes of the wire from the tip backwards, LPS mm, if one is to be shown.
        path: where the picture goes.

    Returns:
        None when the picture is there; otherwise one line that says what to install.
    """
    surface = wall_mesh(anatomy.distance_map, max_triangles=400_000)
    lines = [branch.centerline.points for branch in anatomy.tree.branches]
    with tempfile.TemporaryDirectory() as folder:
        scene, picture = Path(folder) / "scene.npz", Path(folder) / "picture.png"
        np.savez(
            scene,
            vertices=surface.vertices,
            triangles=surface.triangles,
            centerline=np.concatenate(lines),
            centerline_lengths=np.array([len(line) for line in lines]),
            wire=np.empty((0, 3)) if wire is None else wire,
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
    if len(arrays["wire"]) > 1:
        # Drawn thicker than it is, or it would not show at this scale.
        wire: Any = pv.Spline(arrays["wire"], 4 * len(arrays["wire"]))
        plotter.add_mesh(wire.tube(radius=0.0017 * size), color="white", ambient=0.65, smooth_shading=True)
        tip = pv.Sphere(radius=0.005 * size, center=arrays["wire"][0])
        plotter.add_mesh(tip, color="#ffd34d", ambient=0.5, smooth_shading=True)
    plotter.enable_depth_peeling(8)
    plotter.enable_anti_aliasing("ssaa")
    # From the front, a little from the left and above, as from someone who stands before the patient.
    centre = np.mean([arrays["vertices"].min(axis=0), arrays["vertices"].max(axis=0)], axis=0)
    plotter.camera_position = [centre + np.array([0.35, -1.0, 0.22]) * size, centre, (0.0, 0.0, 1.0)]
    plotter.reset_camera()
    plotter.camera.zoom(0.94 / _filled(plotter.camera, np.concatenate([arrays["vertices"], arrays["wire"]])))
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
