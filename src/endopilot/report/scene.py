"""The vessel tree in space with wire and catheters in it, for a browser: turned by hand, replayed with a slider."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.colors import to_hex

from endopilot.anatomy.wall_mesh import wall_mesh
from endopilot.devices.device import Device
from endopilot.devices.stack import lines_from_tips, shown_part
from endopilot.plotting import CATHETER_COLORS, section_colors
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy

BACKGROUND, INK = "#0d1424", "#dfe6f2"
WALL, WIRE, TIP, BELIEVED = "#d98a8a", "#f6f7fb", "#ffd34d", "#5fb8ff"
Wires = Float[np.ndarray, "wires nodes 3"]

_WIRE_WIDTH = 7.0  # width of the wire's line, pixels; a catheter's is as much wider as its diameter
TRAIL_S = 20.0  # how long the path of the tip stays in the picture, s
_VIEWED = 1.3  # length that the camera sees of a vessel, in cube roots of its box's volume
FRAME_MS = 90  # time between two samples when the navigation is played, ms


def navigation_scene(
    anatomy: Anatomy,
    rollout: Trajectory | None = None,
    *,
    devices: Sequence[Device] = (),
    believed: Sequence[Wires] | None = None,
) -> go.Figure:
    """Return a plotly figure of the wall, the centerline by section, and a rollout's first world (with `shape`)
    replayed; `believed` are wires that a policy holds possible at each sample, nodes from the tip on, LPS mm."""
    wall = _wall(anatomy)
    figure = go.Figure([wall, *_centerlines(anatomy)])
    figure.update_layout(_layout(np.ptp([np.asarray(axis) for axis in (wall.x, wall.y, wall.z)], axis=1)))
    if rollout is not None and rollout.shape is not None:
        _add_navigation(figure, rollout, devices, believed)
    return figure


def scene_html(figure: go.Figure) -> Markup:
    """Return a scene as a part of a page, which holds plotly's library."""
    config = {"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["toImage"]}
    how = {"full_html": False, "include_plotlyjs": False, "auto_play": False, "div_id": "navigation"}
    return Markup(figure.to_html(**how, config=config))


def mark_target(
    figure: go.Figure,
    target: Float[np.ndarray, "3"],
    observed: Float[np.ndarray, "exposures 3"],
    seconds: Float[np.ndarray, "exposures"],
) -> None:
    """Add the target to a scene, and where the tip was when X-ray was on, LPS mm."""
    for points, name, marker, labels in (
        (target[None], "Target", {"symbol": "diamond", "size": 6}, ["target"]),
        (observed, "Tip under X-ray", {"symbol": "circle-open", "size": 7}, [f"X-ray at {t:g} s" for t in seconds]),
    ):
        x, y, z = points.T
        marker = marker | {"color": INK}
        hover = {"hovertext": labels, "hoverinfo": "text"}
        figure.add_trace(go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name=name, **hover))


def visible_devices(rollout: Trajectory, world: int, sample: int) -> list[Float[np.ndarray, "_ 3"]]:
    """Return nodes of the wire and catheters from the tip to a little behind the ostium; ValueError without shape."""
    if rollout.shape is None:
        raise ValueError("the rollout holds no wire shapes; simulate with record_shape=True")
    inserted = rollout.inserted_length[world, sample]
    return lines_from_tips(shown_part(rollout.shape[world, sample], float(inserted.max())), inserted)


def _wall(anatomy: Anatomy) -> go.Mesh3d:
    surface = wall_mesh(anatomy.distance_map)
    x, y, z = surface.vertices.T.astype(np.float32)
    i, j, k = surface.triangles.T.astype(np.uint16 if len(surface.vertices) < 2**16 else np.uint32)
    return go.Mesh3d(
        x=x,
        y=y,
        z=z,
        i=i,
        j=j,
        k=k,
        color=WALL,
        opacity=0.22,
        flatshading=False,
        lighting={"ambient": 0.55, "diffuse": 0.7, "specular": 0.35, "roughness": 0.5, "fresnel": 0.8},
        lightposition={"x": 200, "y": -400, "z": 300},
        name="Vessel wall",
        hoverinfo="skip",
        showlegend=True,
    )


def _centerlines(anatomy: Anatomy) -> list[go.Scatter3d]:
    tree = anatomy.tree
    pieces: dict[int, list[np.ndarray]] = {}
    for branch in tree.branches:
        points = branch.centerline.points
        for section in np.unique(branch.section):
            at = np.flatnonzero(branch.section == section)
            # One point before the section joins it to the one that it leaves.
            chosen = points[max(at[0] - 1, 0) : at[-1] + 1]
            pieces.setdefault(int(section), []).extend([chosen, np.full((1, 3), np.nan)])
    lines, palette = [], section_colors(len(pieces))
    for number, (section, parts) in enumerate(sorted(pieces.items())):
        points, name = np.concatenate(parts).astype(np.float32), tree.section_names[section]
        how = {"name": f"Section {name}", "hovertemplate": f"section {name}<extra></extra>"}
        lines.append(_line(points, color=to_hex(palette(number)), width=5, **how))
    return lines


def _add_navigation(
    figure: go.Figure, rollout: Trajectory, devices: Sequence[Device], believed: Sequence[Wires] | None
) -> None:
    samples = np.flatnonzero(rollout.valid[0]).tolist()
    if not samples:
        return
    first = len(list(figure.data))

    def moving(sample: int) -> list[go.Scatter3d]:
        behind = []
        if believed is not None:
            behind = [_possible(believed[sample], float(rollout.inserted_length[0, sample].max()))]
        return [*behind, *_moving(rollout, sample, devices)]

    figure.add_traces(moving(samples[0]))
    traces = list(range(first, len(list(figure.data))))
    figure.frames = [go.Frame(name=str(sample), data=moving(sample), traces=traces) for sample in samples]
    period = rollout.period_s
    animate = {"frame": {"duration": FRAME_MS, "redraw": True}, "transition": {"duration": 0}, "fromcurrent": True}
    stop = {"frame": {"duration": 0, "redraw": True}, "mode": "immediate", "transition": {"duration": 0}}
    figure.update_layout(
        updatemenus=[
            {
                "type": "buttons",
                "direction": "left",
                "showactive": False,
                "x": 0.0,
                "xanchor": "left",
                "y": 0.0,
                "yanchor": "top",
                "pad": {"t": 32, "l": 12},
                "buttons": [
                    {"label": "▶ Play", "method": "animate", "args": [None, animate]},
                    {"label": "❚❚ Pause", "method": "animate", "args": [[None], stop]},
                ],
            }
        ],
        sliders=[
            {
                "x": 0.24,
                "len": 0.74,
                "y": 0.0,
                "pad": {"t": 18, "b": 6},
                "currentvalue": {"prefix": "Time ", "suffix": " s"},
                "steps": [
                    {"label": f"{(sample + 1) * period:g}", "method": "animate", "args": [[str(sample)], stop]}
                    for sample in samples
                ],
            }
        ],
    )


def _moving(rollout: Trajectory, sample: int, devices: Sequence[Device]) -> list[go.Scatter3d]:
    """Return what changes from frame to frame: wire, catheters, the wire's tip and the tip's trail."""
    wire, *around = (np.round(line, 2).astype(np.float32) for line in _uncovered(rollout, sample))
    begin = max(0, sample - round(TRAIL_S / rollout.period_s))
    trail = np.round(rollout.tip_position[0, begin : sample + 1, 0], 2).astype(np.float32)
    tip = trail[-1:]
    time = f"<extra>{(sample + 1) * rollout.period_s:g} s</extra>"
    hover = f"{_state(rollout, sample, 0)}<br>largest wall force = {rollout.contact_force_max[0, sample]:.3f} N{time}"
    name = f"Guidewire {devices[0].name}" if around else "Guidewire"
    tubes = [
        _line(
            line,
            color=CATHETER_COLORS[k],
            width=round(_WIRE_WIDTH * devices[k + 1].diameter_mm / devices[0].diameter_mm, 1),
            name=f"Catheter {devices[k + 1].name}",
            hovertemplate=_state(rollout, sample, k + 1) + time,
        )
        for k, line in enumerate(around)
    ]
    x, y, z = tip.T
    marker = {"color": TIP, "size": 5}
    return [
        _line(wire, color=WIRE, width=_WIRE_WIDTH, name=name, hovertemplate=hover),
        *tubes,
        _line(trail, color=TIP, width=2.0, name=f"Tip, last {TRAIL_S:g} s", hoverinfo="skip"),
        go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name="Tip", hovertemplate=hover),
    ]


def _uncovered(rollout: Trajectory, sample: int) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the nodes of each device up to where the one around it ends; its tip alone if it lies within."""
    lines, inserted = visible_devices(rollout, 0, sample), rollout.inserted_length[0, sample]
    found = []
    for k, line in enumerate(lines):
        outer = max(range(k + 1, len(lines)), key=lambda j: inserted[j], default=None)
        if outer is None:
            found.append(line)
        elif inserted[outer] >= inserted[k]:
            found.append(line[:1])  # draws nothing, and keeps the name in the legend
        else:
            ahead = len(line) - len(lines[outer]) + 1  # lines share the nodes behind their tips
            found.append(np.vstack([line[:ahead], lines[outer][:1]]))
    return found


def _state(rollout: Trajectory, sample: int, k: int) -> str:
    tip = rollout.tip
    return (
        f"Δ = {rollout.inserted_length[0, sample, k]:.1f} mm<br>"
        f"φ = {np.rad2deg(rollout.rotation[0, sample, k]):.0f}°<br>"
        f"Δtip = {tip.abscissa[0, sample, k]:.1f} mm<br>"
        f"γtip = {tip.offset[0, sample, k]:.2f} mm, lumen radius = {tip.radius[0, sample, k]:.2f} mm<br>"
        f"push of its drive = {rollout.drive_force[0, sample, k]:.2f} N"
    )


def _line(points: np.ndarray, *, color: str, width: int | float, **how: object) -> go.Scatter3d:
    x, y, z = points.T
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line={"color": color, "width": width}, **how)


def _possible(wires: Wires, deepest_mm: float) -> go.Scatter3d:
    """Return the wires that a policy holds possible, as one line with gaps."""
    gap = np.full((1, 3), np.nan)
    parts = [part for nodes in wires for part in (shown_part(nodes, deepest_mm), gap)]
    points = np.round(np.concatenate(parts), 2).astype(np.float32)
    return _line(points, color=BELIEVED, width=2.0, opacity=0.5, name="Wires held possible", hoverinfo="skip")


def _layout(size_mm: Float[np.ndarray, "3"]) -> dict:
    # plotly's box keeps its volume, so that of a tall vessel is longer than the usual view is high
    farther = max(1.0, float(size_mm.max() / size_mm.prod() ** (1 / 3)) / _VIEWED)
    eye = {name: farther * at for name, at in zip("xyz", (0.4, -2.0, 0.5), strict=True)}
    axis = {"backgroundcolor": BACKGROUND, "showspikes": False}
    titles = ("x (left), mm", "y (back), mm", "z (head), mm")
    axes = {f"{name}axis": axis | {"title": {"text": title}} for name, title in zip("xyz", titles, strict=True)}
    return {
        # View from the front, as a surgeon stands before the patient: the patient's left is on the right.
        "scene": {"aspectmode": "data", **axes, "camera": {"eye": eye, "center": {"x": 0, "y": 0, "z": -0.12}}},
        "template": "plotly_dark",
        "paper_bgcolor": BACKGROUND,
        "legend": {"x": 0.99, "xanchor": "right", "y": 0.93, "bgcolor": BACKGROUND},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "height": 680,
        "uirevision": "keep",
    }
