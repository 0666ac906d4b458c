"""A still picture of the vessel, wire and catheters in it, by VTK in a process of its own: VTK aborts where it finds no
graphics library, and its failure is then one clear line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from endopilot.anatomy.wall_mesh import WallMesh, wall_mesh
from endopilot.devices.device import Device
from endopilot.files import png_image, write_whole
from endopilot.parallel import Workers
from endopilot.plotting import CATHETER_COLORS
from endopilot.types import Anatomy

LIBRARIES_MISSING = (
    "the still 3-D picture is left out: VTK finds no graphics library; "
    "`apt-get install libegl1 libgl1-mesa-dri` (or libosmesa6) and run the same command again"
)
TIMEOUT_S = 180
SIZE = (1600, 1000)
_CATHETER_OPACITY = 0.45
Lines = Sequence[Float[np.ndarray, "_ 3"]]


def render_still(anatomy: Anatomy, lines: Lines, path: Path, *, devices: Sequence[Device] = ()) -> str | None:
    """Render the vessel's wall, its centerline, and `lines` (nodes of the wire, then of each catheter, from the tip,
    LPS mm) to a PNG; return None, or a line that says what to install."""
    surface = wall_mesh(anatomy.distance_map, max_triangles=400_000)
    centerlines = [branch.centerline.points for branch in anatomy.tree.branches]
    widths = [device.diameter_mm / devices[0].diameter_mm for device in devices] or [1.0] * len(lines)
    try:
        with Workers(1) as process:
            picture = process.submit(render, surface, centerlines, lines, widths).result(TIMEOUT_S)
    except (RuntimeError, TimeoutError):  # one that died is a RuntimeError
        return LIBRARIES_MISSING
    write_whole(path, png_image(picture))
    return None


def render(surface: WallMesh, centerlines: Lines, lines: Lines, widths: Sequence[float]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture, drawn in this process."""
    import pyvista as pv  # in the process alone

    plotter: Any = pv.Plotter(off_screen=True, window_size=list(SIZE), lighting="three lights")
    plotter.set_background("#0a1120", top="#1f3155")
    wall: Any = pv.PolyData.from_regular_faces(surface.vertices, surface.triangles).smooth_taubin(n_iter=30)
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    look = {"smooth_shading": True, "specular": 0.9, "specular_power": 30, "ambient": 0.18, "diffuse": 0.9}
    plotter.add_mesh(wall, color="#e2595e", opacity=0.30, **look)
    for line in centerlines:
        plotter.add_mesh(pv.lines_from_points(line), color="#ffc9b8", line_width=1.5, opacity=0.55)
    for k, (line, width) in enumerate(zip(lines, widths, strict=True)):
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
    centre = np.mean([surface.vertices.min(axis=0), surface.vertices.max(axis=0)], axis=0)
    plotter.camera_position = [centre + np.array([0.35, -1.0, 0.22]) * size, centre, (0.0, 0.0, 1.0)]
    plotter.reset_camera()
    plotter.camera.zoom(0.94 / _filled(plotter.camera, np.concatenate([surface.vertices, *lines])))
    picture = plotter.screenshot(None, return_img=True)
    plotter.close()
    return picture


def _filled(camera: Any, points: np.ndarray) -> float:
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
