"""The drive as a process, over TCP: a controller drives it, and the plug is pulled."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from endopilot.control import remote
from endopilot.control.remote import RemoteRobot
from endopilot.control.robot import Robot
from endopilot.errors import InputError

SECRET = b"0123456789abcdef"
OBEYED = ("armed", "stopped:silence")  # a machine under load may need more than 200 ms between two lines
MAIN = "from endopilot.cli import main; main()"
CLIENT = """
import sys, time
from endopilot.control.remote import RemoteRobot
robot = RemoteRobot("127.0.0.1", int(sys.argv[1]), b"0123456789abcdef")
while True:
    if robot.status != "armed":
        robot.arm()  # a machine under load may itself keep silent for too long
    robot.command(10.0, 0.0)
    print(robot.proximal_state().inserted_length, flush=True)
    time.sleep(0.05)
"""


@pytest.fixture
def drive(tmp_path):
    """Start a drive on a free port, and return its process and the port."""
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET)
    secret.chmod(0o600)
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "drive", "--secret", str(secret), "--port", "0"], stdout=subprocess.PIPE, text=True
    )
    found = re.fullmatch(r"listening on 127\.0\.0\.1:(\d+)\n", process.stdout.readline())
    yield process, int(found.group(1))
    process.terminate()
    process.wait(timeout=20)
    process.stdout.close()


def wait_for(process: subprocess.Popen, text: str) -> None:
    """Read what the drive reports until a line holds some text."""
    assert any(text in line for line in iter(process.stdout.readline, ""))


def test_it_stops_when_its_client_is_killed(drive) -> None:
    process, port = drive
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(port)], stdout=subprocess.PIPE, text=True)
    while float(client.stdout.readline()) < 2.0:
        pass
    client.send_signal(signal.SIGKILL)
    client.wait()
    client.stdout.close()
    wait_for(process, "the client has disconnected")
    with RemoteRobot("127.0.0.1", port, SECRET) as robot:
        readings = [robot.proximal_state()]
        while readings[-1].time_s < readings[0].time_s + 1.0:
            time.sleep(0.02)
            readings.append(robot.proximal_state())
    places = [reading.inserted_length for reading in readings if reading.time_s > readings[0].time_s + 0.3]
    assert np.ptp(places) < 0.2  # encoder noise alone, of 0.02 mm


def test_it_stops_when_its_client_falls_silent_and_goes_on_when_armed(drive, monkeypatch) -> None:
    process, port = drive
    monkeypatch.setattr(remote, "REPEAT_S", 1e6)  # the thread that repeats commands hangs
    with RemoteRobot("127.0.0.1", port, SECRET) as robot:
        assert isinstance(robot, Robot)
        robot.command(10.0, 1.0)
        wait_for(process, ": silence;")
        robot.command(10.0, 1.0)
        assert robot.status == "stopped:silence"
        robot.arm()
        robot.command(np.nan, 1.0)
        assert robot.status in OBEYED  # what is sent is finite: the wire stands still
        robot.command(1e9, -1e9)
        assert robot.status in OBEYED


def test_a_controller_that_hangs_stops_it(drive, monkeypatch) -> None:
    process, port = drive
    monkeypatch.setattr(remote, "HOLD_S", 0.3)
    with RemoteRobot("127.0.0.1", port, SECRET) as robot:
        robot.command(5.0, 0.0)
        wait_for(process, ": silence;")  # commands are repeated for a while, and then no more


def test_it_refuses_a_second_client_and_another_secret(drive) -> None:
    _, port = drive
    with RemoteRobot("127.0.0.1", port, SECRET) as robot:
        with pytest.raises(InputError, match="another client"):
            RemoteRobot("127.0.0.1", port, SECRET)
        # strangers do not disturb it
        with socket.create_connection(("127.0.0.1", port)) as stranger:
            stranger.sendall(b"\x00" * 100_000 + b"\n1 STOP\n1 AUTH " + b"0" * 64 + b"\n")
            robot.arm()
            robot.command(1.0, 0.0)
            assert robot.status in OBEYED
    with pytest.raises(InputError, match="check the secret"):
        RemoteRobot("127.0.0.1", port, b"another secret..")


def test_it_says_where_nothing_listens(tmp_path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="no drive at"):
            RemoteRobot("127.0.0.1", free.getsockname()[1], SECRET)
