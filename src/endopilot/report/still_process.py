"""Renders one still picture with VTK; `still.py` runs it as a process, which imports nothing else of endopilot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

SIZE = (1600, 1000)
_CATHETER_OPACITY = 0.45


def render(scene: Path, path: Path) -> None:
    """Draw the scene that `still.render_still` wrote to a file."""
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
        color = str(arrays["catheter_colors"][k - 1])
        seen = {"color": color, "opacity": _CATHETER_OPACITY} if k else {"color": "white"}
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


if __name__ == "__main__":
    render(Path(sys.argv[1]), Path(sys.argv[2]))
