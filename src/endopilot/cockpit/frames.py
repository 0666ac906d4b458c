"""What the server sends: binary messages of a JSON header and raw arrays, one layout for all kinds: the header's length
(uint32), the header (UTF-8 JSON, padded with spaces to a multiple of four bytes), and the arrays, little-endian, each
padded alike. `header["arrays"]` lists their name, type ("f4", "u4" or "u1") and shape."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.cockpit.world import Snapshot
from endopilot.tasks.navigation import Navigation
from endopilot.types import Anatomy

_TYPES = {np.dtype("<f4"): "f4", np.dtype("<u4"): "u4", np.dtype("u1"): "u1"}
WALL_TRIANGLES = 14_000  # triangles of the lumen in the page at most: software rendering must keep up
_POINT_MM = 1.0  # distance between the points of the centerline in the page, mm


def encode(kind: str, header: dict[str, Any], **arrays: np.ndarray) -> bytes:
    """Return a message of a header and arrays of float32, uint32 or uint8."""
    listed = [{"name": name, "type": _TYPES[array.dtype], "shape": array.shape} for name, array in arrays.items()]
    text = json.dumps(header | {"type": kind, "arrays": listed}, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    parts = [struct.pack("<I", len(text)), text]
    for array in arrays.values():
        data = np.ascontiguousarray(array).tobytes()
        parts += [data, b"\0" * (-len(data) % 4)]
    return b"".join(parts)


def decode(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return header and arrays of a message that `encode` made."""
    (length,) = struct.unpack_from("<I", message)
    header = json.loads(message[4 : 4 + length])
    arrays, at = {}, 4 + length
    for entry in header["arrays"]:
        kind = np.dtype(f"<{entry['type']}")
        count = int(np.prod(entry["shape"]))
        arrays[entry["name"]] = np.frombuffer(message, kind, count, at).reshape(entry["shape"])
        at += count * kind.itemsize + (-count * kind.itemsize) % 4
    return header, arrays


def device_arrays(snapshot: Snapshot) -> dict[str, np.ndarray]:
    """Return what the page needs to draw wire and catheters: nodes of each, LPS mm, and the wall's force there, N."""
    arrays = {"nodes": snapshot.nodes.astype("<f4"), "node_force": snapshot.node_force.astype("<f4")}
    for number, catheter in enumerate(snapshot.catheters, start=1):
        arrays[f"catheter_{number}_nodes"] = catheter.nodes.astype("<f4")
        arrays[f"catheter_{number}_force"] = catheter.node_force.astype("<f4")
    return arrays


def motion_values(snapshot: Snapshot, counted: Float[np.ndarray, "devices 2"] | None = None) -> dict[str, Any]:
    """Return insertion, rotation and drives' figures of wire and catheters; `counted` are lengths (mm) and rotations
    (rad) as encoders have them, the true ones if not given."""

    true = [(device.inserted_length_mm, device.rotation) for device in (snapshot, *snapshot.catheters)]
    wire, *catheters = (
        {"inserted_length_mm": round(inserted, 3), "rotation_deg": round(float(np.rad2deg(turned)), 2)}
        for inserted, turned in (true if counted is None else counted.tolist())
    )
    return {
        "cycle": snapshot.cycle,
        "time_s": round(snapshot.time_s, 4),
        **wire,
        **({"catheters": catheters} if catheters else {}),
        "velocity": snapshot.velocity,
        "drive_load": snapshot.drive_load,
        "slip": snapshot.slip,
        "valid": snapshot.valid,
    }


def tip_values(anatomy: Anatomy, snapshot: Snapshot) -> dict[str, Any]:
    """Return where the tips are and what the wall does to the devices, for the page's figures."""
    branch = int(snapshot.tip.branch[0])
    line, labels = anatomy.tree.branches[branch].centerline, anatomy.tree.branches[branch].section
    nearest = int(np.abs(line.abscissa - snapshot.tip.abscissa[0]).argmin())
    ends = [round(float(catheter.tip.abscissa[0]), 2) for catheter in snapshot.catheters]
    return ({"catheter_tips_mm": ends} if ends else {}) | {
        "tip_mm": round(float(snapshot.tip.abscissa[0]), 2),
        "section": anatomy.tree.section_names[int(labels[nearest])],
        "force_n": round(snapshot.force_n, 4),
    }


def scene(navigation: Navigation, about: dict[str, Any]) -> bytes:
    """Return what does not move: the lumen, the centerlines with the names of their sections, devices and target."""
    from endopilot.anatomy.wall_mesh import wall_mesh  # slow to import, and needed in the thread that makes the scene

    anatomy, device = navigation.anatomy, navigation.device
    wall = wall_mesh(anatomy.distance_map, max_triangles=WALL_TRIANGLES)
    lines, points, labels, places = [], [], [], []
    for branch in anatomy.tree.branches:
        line = branch.centerline
        wanted = np.append(np.arange(line.abscissa[0], line.abscissa[-1], _POINT_MM), line.abscissa[-1])
        chosen = np.unique(np.searchsorted(line.abscissa, wanted).clip(0, len(line.abscissa) - 1))
        lines.append(len(chosen))
        points.append(line.points[chosen])
        labels.append(branch.section[chosen])
        places.append(line.abscissa[chosen])
    names = anatomy.tree.section_names
    present = sorted({int(label) for part in labels for label in part})
    header = about | {
        "name": anatomy.name,
        "wire": device.name,
        "diameter_mm": device.diameter_mm,
        "force_limit_n": navigation.force_limit_n,
        "push_limit_n": device.push_limit_n,
        "lines": lines,
        "sections": [{"label": label, "name": names[label]} for label in present],
        "ostium": anatomy.insertion.position.round(3).tolist(),
        "guiding_catheter": {
            "direction": anatomy.insertion.direction.round(5).tolist(),
            "radius_mm": float(anatomy.catheter_radius_mm),
        },
    }
    if navigation.catheters:
        header["catheters"] = [
            {"name": each.name, "diameter_mm": each.diameter_mm, "push_limit_n": each.push_limit_n}
            for each in navigation.catheters
        ]
    return encode(
        "scene",
        header,
        vertices=wall.vertices.astype("<f4"),
        triangles=wall.triangles.astype("<u4"),
        points=np.concatenate(points).astype("<f4"),
        labels=np.concatenate(labels).astype("<u4"),
        abscissa=np.concatenate(places).astype("<f4"),
    )
