"""Wire, catheters, tip, target and vessel for 3D Slicer, live by OpenIGTLink: `Streamed`, a stage around another.

3D Slicer takes coordinates as RAS mm: x and y change their signs.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import pyigtl
from jaxtyping import Float

from endopilot.cockpit.frames import decode
from endopilot.cockpit.messages import Message
from endopilot.cockpit.session import Stage
from endopilot.robot.drive import listen

FRAME_S = 0.04
"""Time between what is sent, s: 25 a second."""
_BUFFER_BYTES = 4_000_000  # holds the vessel, which is half a megabyte, and many frames


class Streamed:
    """A stage whose devices, tip and target go to all who connect to a port of this machine, and its vessel first."""

    def __init__(self, stage: Stage, scene: Callable[[], bytes], port: int) -> None:
        """Listen on a TCP port; `scene` returns the message of what does not move. InputError if the port is taken."""
        self._stage, self._scene, self._next_s = stage, scene, -np.inf
        self._peers: list[socket.socket] = []
        self._listener = listen("127.0.0.1", port, named="igtl")
        self._listener.setblocking(False)

    @property
    def port(self) -> int:
        """The TCP port."""
        return self._listener.getsockname()[1]

    def handle(self, message: Message, now_s: float) -> None:
        """Hand a page's message on."""
        self._stage.handle(message, now_s)

    def halt(self, why: str) -> None:
        """Stop the wire."""
        self._stage.halt(why)

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Let one cycle pass, and send what it shows if that is due."""
        sent = self._stage.cycle(now_s)
        if now_s >= self._next_s:
            self._next_s = now_s + FRAME_S
            state = dict(sent).get("state")
            if self.watched() and state is not None:
                self._send(self._peers, _devices(state))
        return sent

    def watched(self) -> bool:
        """Let who asks connect, and return whether somebody is, so that time passes without a page."""
        with contextlib.suppress(BlockingIOError):
            peer, _ = self._listener.accept()
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            peer.settimeout(FRAME_S)
            self._peers.append(peer)
            self._send([peer], _vessel(self._scene()))
        return bool(self._peers)

    def close(self) -> None:
        """End the stage, and hang up."""
        self._stage.close()
        for each in (self._listener, *self._peers):
            each.close()

    def _send(self, peers: Sequence[socket.socket], messages: Iterable[pyigtl.MessageBase]) -> None:
        """Send messages; who has hung up, or does not keep up, is let go."""
        data = b"".join(message.pack() for message in messages)
        for peer in tuple(peers):
            try:
                peer.sendall(data)
            except OSError:
                peer.close()
                self._peers.remove(peer)


def _vessel(scene: bytes) -> Iterator[pyigtl.MessageBase]:
    """Yield the lumen as triangles, and the centerlines."""
    header, arrays = decode(scene)
    triangles = np.insert(arrays["triangles"], 0, 3, axis=1)
    yield pyigtl.PolyDataMessage(points=_ras(arrays["vertices"]), polygons=triangles.ravel(), device_name="Vessel")
    yield _lines(arrays["points"], header["lines"], "Centerlines")


def _devices(state: bytes) -> Iterator[pyigtl.MessageBase]:
    """Yield wire and catheters as lines, the tip's pose (z points ahead), and the target."""
    header, arrays = decode(state)
    names = {"nodes": "Wire"} | {f"catheter_{number}_nodes": f"Catheter{number}" for number in (1, 2)}
    for name in names.keys() & arrays.keys():
        yield _lines(arrays[name], [len(arrays[name])], names[name])
    if "nodes" in arrays:
        yield pyigtl.TransformMessage(matrix=_pose(_ras(arrays["nodes"][:2])), device_name="Tip")
    if header.get("target"):
        position = _ras(np.array([header["target"]["position"]]))
        yield pyigtl.PointMessage(positions=position, names=[header["target"]["section"]], device_name="Target")


def _lines(points: np.ndarray, counts: list[int], name: str) -> pyigtl.PolyDataMessage:
    starts = np.cumsum([0, *counts[:-1]])
    cells = [np.array([count, *range(start, start + count)]) for start, count in zip(starts, counts, strict=True)]
    return pyigtl.PolyDataMessage(points=_ras(points), lines=np.concatenate(cells), device_name=name)


def _ras(points: np.ndarray) -> Float[np.ndarray, "n 3"]:
    return points.astype(float) * np.array([-1.0, -1.0, 1.0])


def _pose(ends: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a tip from its first two nodes: the origin is the tip, z points ahead."""
    ahead = (ends[0] - ends[1]) / np.linalg.norm(ends[0] - ends[1])
    across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    across = across / np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3] = np.stack([across, np.cross(ahead, across), ahead, ends[0]], axis=1)
    return pose
