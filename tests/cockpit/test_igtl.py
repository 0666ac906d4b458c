"""What 3D Slicer is sent, read from the socket by the layout of OpenIGTLink."""

import itertools
import socket
import struct

import numpy as np
import pytest

pytest.importorskip("pyigtl", reason="the extra `slicer` is not installed")
import pyigtl

from endopilot.cockpit.frames import decode, scene
from endopilot.cockpit.igtl import FRAME_S, Streamed
from endopilot.errors import InputError

RAS = np.array([-1.0, -1.0, 1.0])
TIMES = itertools.count(0.0, FRAME_S)


@pytest.fixture
def streamed(session):
    stage = Streamed(session, lambda: scene(session.world.navigation, {}), 0)
    yield stage
    stage.close()


def test_time_passes_while_slicer_looks(streamed):
    assert not streamed.watched()
    with socket.create_connection(("127.0.0.1", streamed.port), timeout=10):
        assert streamed.watched()


def read(stage, names=frozenset({"Vessel", "Centerlines", "Wire", "Tip", "Target"})):
    """Connect, let a cycle pass, and return the bodies of the messages that come, and what the page is shown."""
    bodies = {}
    with socket.create_connection(("127.0.0.1", stage.port), timeout=10) as peer, peer.makefile("rb") as stream:
        shown = decode(dict(stage.cycle(next(TIMES)))["state"])
        while bodies.keys() != names:
            header = pyigtl.MessageBase.parse_header(stream.read(pyigtl.MessageBase.IGTL_HEADER_SIZE))
            bodies[header["device_name"]] = stream.read(header["body_size"])
    return bodies, shown


def test_slicer_is_sent_the_vessel_and_what_moves_in_it(streamed, session):
    bodies, (_, arrays) = read(streamed)
    points, lines, _ = polydata(bodies["Wire"])
    np.testing.assert_allclose(points, RAS * arrays["nodes"], atol=1e-4)
    np.testing.assert_array_equal(lines, [len(points), *range(len(points))])
    pose = np.frombuffer(bodies["Tip"], ">f4").reshape(4, 3).T
    np.testing.assert_allclose(pose[:, 3], RAS * arrays["nodes"][0], atol=1e-4)
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-5)
    ahead = RAS * (arrays["nodes"][0] - arrays["nodes"][1])
    assert pose[:, 2] @ ahead == pytest.approx(np.linalg.norm(ahead), rel=1e-5)
    place = RAS * session.target.position(session.world.navigation.anatomy)
    np.testing.assert_allclose(np.frombuffer(bodies["Target"][100:112], ">f4"), place, atol=1e-3)
    vertices, _, triangles = polydata(bodies["Vessel"])
    np.testing.assert_allclose(vertices, RAS * decode(streamed._scene())[1]["vertices"], atol=1e-4)
    assert triangles[0] == 3 and triangles.reshape(-1, 4)[:, 1:].max() == len(vertices) - 1


def test_the_vessel_is_sent_again_to_whoever_connects_next(streamed):
    first, second = (read(streamed)[0]["Vessel"] for _ in range(2))
    assert first == second


def test_a_port_that_is_taken_is_named(streamed, session):
    with pytest.raises(InputError, match=f"igtl: cannot listen on 127.0.0.1:{streamed.port} .*choose others"):
        Streamed(session, lambda: b"", streamed.port)


def polydata(body):
    """Return points, lines and polygons of a POLYDATA message (openigtlink.org, v2, big-endian)."""
    sizes = struct.unpack(">10I", body[:40])
    points, vertices, lines, polygons = sizes[0], sizes[2], sizes[4], sizes[6]
    parts = np.split(np.frombuffer(body, "u1", offset=40), np.cumsum([12 * points, vertices, lines, polygons]))
    return parts[0].view(">f4").reshape(-1, 3), parts[2].view(">u4"), parts[3].view(">u4")
