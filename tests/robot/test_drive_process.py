"""The drive as a process, over TLS: a controller drives it, and its end is told."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import threading
import time

import numpy as np
import pytest
from drives import HOST, running

from endopilot.errors import InputError
from endopilot.robot.drive import tls_context
from endopilot.robot.remote import RemoteRobot
from endopilot.robot.robot import Robot

OBEYED = ("armed", "stopped:silence")  # a machine under load may need more than 200 ms between two lines


def test_it_stops_200_ms_after_the_last_call_and_goes_on_at_the_next(drive, certificates) -> None:
    _, port = drive
    with RemoteRobot(HOST, port, certificates) as robot:
        assert isinstance(robot, Robot)
        for speed in (10.0, -10.0, 10.0):
            before = robot.proximal_state()
            robot.command(((speed, 1.0),))
            while robot.status == "armed":  # the caller looks on, and commands nothing more
                time.sleep(0.01)
                stopped = robot.proximal_state()
            assert robot.status == "stopped:silence"
            time.sleep(0.2)
            way = robot.proximal_state().devices[0][0] - before.devices[0][0]
            assert 0.3 < way * np.sign(speed) < 10.0 * 0.2 + 0.2  # the encoder's noise is 0.02 mm
            assert abs(robot.proximal_state().devices[0][0] - stopped.devices[0][0]) < 10.0 * 0.05 + 0.1
        robot.command(((np.nan, 1.0),))
        assert robot.status in OBEYED  # what is sent is finite: the wire stands still
        robot.command(((1e9, -1e9),))
        assert robot.status in OBEYED
        # after a stop that the caller asked for, with or without silence before, it must be armed
        for wait_s in (0.0, 0.4):
            time.sleep(wait_s)
            robot.stop()
            robot.command(((10.0, 0.0),))
            assert robot.status == "stopped:asked"
            robot.arm()
            robot.command(((10.0, 0.0),))
            assert robot.status in OBEYED


def test_a_command_is_held_while_its_caller_waits(drive, certificates) -> None:
    _, port = drive
    with RemoteRobot(HOST, port, certificates) as robot:
        before = robot.proximal_state()
        robot.command(((10.0, 0.0),))
        robot.run(1.0)
        after = robot.proximal_state()
        assert robot.status in OBEYED
        assert after.devices[0][0] - before.devices[0][0] > 5.0  # 10 mm on a machine that is not under load
        while robot.status != "stopped:silence":
            robot.proximal_state()


def test_any_thread_may_call_it(drive, certificates) -> None:
    _, port = drive
    failures: list[Exception] = []

    def call(robot: RemoteRobot, speed: float) -> None:
        try:
            for _ in range(50):
                robot.command(((speed, 0.0),))
                assert robot.proximal_state().time_s > 0.0
        except Exception as error:
            failures.append(error)

    with RemoteRobot(HOST, port, certificates) as robot:
        threads = [threading.Thread(target=call, args=(robot, speed)) for speed in (0.0, 1.0, 2.0)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not failures
    for call_again in (robot.arm, robot.stop, robot.proximal_state, lambda: robot.command(((1.0, 0.0),)), robot.arm):
        with pytest.raises(InputError, match="it was closed"):
            call_again()
    robot.close()


@pytest.mark.parametrize(
    ("ending", "connected"), [(signal.SIGINT, False), (signal.SIGINT, True), (signal.SIGTERM, True)]
)
def test_ctrl_c_and_sigterm_end_it_with_one_line(certificates, ending, connected) -> None:
    with running(certificates) as (process, port), contextlib.ExitStack() as clients:
        if connected:
            robot = clients.enter_context(RemoteRobot(HOST, port, certificates))
            robot.command(((10.0, 0.0),))
            clients.enter_context(socket.create_connection((HOST, port)))  # and one that waits
        process.send_signal(ending)
        _, errors = process.communicate(timeout=20)
        word = "interrupted" if ending is signal.SIGINT else "terminated"
        assert (process.returncode, errors) == (128 + ending, f"endopilot drive: {word}\n")
        if connected:
            with pytest.raises(InputError, match="the connection is lost"):
                robot.command(((1.0, 0.0),))


def test_it_refuses_a_second_client_and_strangers(drive, certificates, make_certificates, tmp_path) -> None:
    _, port = drive
    strange = make_certificates(tmp_path / "strange")
    half = tmp_path / "half"  # knows the drive, which does not know it
    half.mkdir()
    for name, folder in (("drive.crt", certificates), ("client.key", strange), ("client.crt", strange)):
        (half / name).write_bytes((folder / name).read_bytes())
    (half / "client.key").chmod(0o600)
    with RemoteRobot(HOST, port, certificates) as robot:
        with pytest.raises(InputError, match="another client"):
            RemoteRobot(HOST, port, certificates)
        with pytest.raises(InputError, match=r"certificates: the drive at .* is not that of .*strange/drive.crt"):
            RemoteRobot(HOST, port, strange)
        with pytest.raises(InputError, match=r"certificates: the drive at .* closed .* copy .*half/client.crt"):
            RemoteRobot(HOST, port, half)
        with socket.create_connection((HOST, port)) as plain:  # no TLS
            plain.sendall(b"\x00" * 100_000 + b"\nSTOP\n")
            robot.arm()
            robot.command(((1.0, 0.0),))
            assert robot.status in OBEYED


def test_it_says_where_no_drive_is(certificates) -> None:
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        port = listener.getsockname()[1]
        with pytest.raises(InputError, match="no drive at"):
            RemoteRobot(HOST, port, certificates)
        listener.listen()

        def greet() -> None:
            with listener.accept()[0] as connection:
                connection.sendall(b"endopilot-drive 1 00\n")
                connection.recv(4096)

        thread = threading.Thread(target=greet)
        thread.start()
        with pytest.raises(InputError, match=r"begins no TLS 1\.3"):
            RemoteRobot(HOST, port, certificates)
        thread.join()
    for host, number in (("", 1), ("x" * 80, 1), (HOST, 99999)):
        with pytest.raises(InputError, match="no drive at"):
            RemoteRobot(host, number, certificates)


def test_certificates_are_checked(make_certificates, tmp_path) -> None:
    folder = make_certificates(tmp_path / "good")
    other = make_certificates(tmp_path / "other")
    tls_context(folder, of_drive=True)

    def refuses(name: str, content: bytes, match: str) -> None:
        before = (folder / name).read_bytes()
        (folder / name).write_bytes(content)
        with pytest.raises(InputError, match=match):
            tls_context(folder, of_drive=True)
        (folder / name).write_bytes(before)

    refuses("drive.key", (other / "drive.key").read_bytes(), "certificates: .*drive.crt and .*drive.key are no")
    refuses("drive.key", b"", "drive.key are no")
    refuses("drive.crt", b"nothing", "drive.crt and .*drive.key are no")
    refuses("client.crt", b"", r"certificates: .*client.crt holds no certificate")
    locked = ["openssl", "pkey", "-aes128", "-passout", "pass:1234", "-in", folder / "drive.key"]
    key = subprocess.run(locked, check=True, capture_output=True).stdout
    refuses("drive.key", key, "unencrypted key")
    (folder / "drive.key").chmod(0o640)
    with pytest.raises(InputError, match="chmod 600"):
        tls_context(folder, of_drive=True)
    (folder / "client.crt").unlink()
    with pytest.raises(InputError, match=r"client.crt: no such file"):
        tls_context(folder, of_drive=True)
