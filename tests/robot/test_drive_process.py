"""The drive as a process, over TLS: a controller drives it, its end is told, and attackers move nothing for long:
whatever a client sent before it hung, nothing moves for more than 200 ms after."""

from __future__ import annotations

import contextlib
import re
import signal
import socket
import subprocess
import threading
import time

import numpy as np
import pytest
from drives import HOST, running

from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.robot.drive import BRAKING_S, LASTS_S, LONGEST_LINE, tls_context
from endopilot.robot.remote import RemoteRobot
from endopilot.robot.robot import Robot

OBEYED = ("armed", "stopped:silence")  # a machine under load may need more than 200 ms between two lines


def test_it_stops_200_ms_after_the_last_call_and_goes_on_at_the_next(drive, certificates) -> None:
    _, port = drive
    with RemoteRobot(HOST, port, certificates) as robot:
        assert isinstance(robot, Robot)
        robot.command(((10.0, 0.0),))  # away from the end of the travel, where going back would stop it
        robot.run(1.0)
        while robot.status != "stopped:silence":
            robot.proximal_state()
        time.sleep(0.2)
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


SPEED = 20.0
"""Of the wire when the attack begins, mm/s."""
NOISE_MM = 6 * RobotConfig().wire.encoder_sd_mm * 2**0.5
MOST_MM = SPEED * (LASTS_S + BRAKING_S / 2) + NOISE_MM
"""Way at full speed until the watchdog stops the drive, and, from the highest speed, the way of the braking."""


class Attacker:
    """A client that speaks the protocol by hand.

    Attributes:
        ticket: the newest that it read.
        clock: of the drive, when it gave the newest answer read, s.
        place: Δ then, mm.
    """

    def __init__(self, port: int, certificates) -> None:
        context = tls_context(certificates, of_drive=False)
        plain = socket.socket()
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)  # else the machine holds what nobody reads
        plain.settimeout(5.0)
        plain.connect((HOST, port))
        self.socket = context.wrap_socket(plain)
        self.lines = self.socket.makefile("rb")
        self.lines.readline()
        self.ask("STATE")
        self.ask(f"ARM {self.ticket}")

    def ask(self, line: str) -> str:
        """Send a line, and return the status that the answer gives."""
        self.socket.sendall(f"{line}\n".encode())
        _, clock, place, *_, status, self.ticket = self.lines.readline().decode().split()
        self.clock, self.place = float(clock), float(place)
        return status

    def close(self) -> None:
        self.lines.close()
        self.socket.close()

    def drive(self, seconds: float) -> None:
        """Go forward as a good client does."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            if self.ask(f"MOVE {self.ticket} {SPEED} 0.0") != "armed":  # a machine under load
                self.ask(f"ARM {self.ticket}")
            time.sleep(0.01)

    def push(self, data: bytes, patience_s: float) -> None:
        """Send without reading, until the drive hangs up, or the connection takes no more for `patience_s`."""
        self.socket.settimeout(patience_s)
        with contextlib.suppress(OSError):
            self.socket.sendall(data)


MOVE, ARM = f"MOVE {{ticket}} {SPEED} 0.0\n", "ARM {ticket}\n"
ATTACKS = {
    "flood": MOVE * 40_000,
    "flood with arms": (ARM + MOVE) * 20_000,
    "hang within a line": MOVE[:-5],
    "a line without end": "1" * (100 * LONGEST_LINE),
    "ask and never read": "STATE\n" * 400_000,
    "guess tickets": "".join(f"MOVE {number:016x} {SPEED} 0.0\n" for number in range(20_000)),
    "flood while the drive is held up": MOVE * 40_000,
}


@pytest.fixture(scope="module")
def attacked(certificates):
    """Start a drive whose reports nobody but the attacks' test leaves unread, and return its process and the port."""
    with running(certificates) as started:
        yield started


def until_disconnected(process: subprocess.Popen) -> str:
    """Return what the drive reports until its client is gone."""
    return "".join(iter(process.stdout.readline, "the client has disconnected\n"))


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_moves_200_ms_after_the_client_heard_the_drive(attacked, certificates, attack) -> None:
    process, port = attacked
    attacker = Attacker(port, certificates)
    attacker.drive(0.3)
    attacker.ask(MOVE.strip().format(ticket=attacker.ticket))
    if held_up := "held up" in attack:
        process.send_signal(signal.SIGSTOP)
    # a drive under load reads late, but it reads; one that is held up reads nothing
    attacker.push(ATTACKS[attack].replace("{ticket}", attacker.ticket).encode(), 0.5 if held_up else 20.0)
    if held_up:
        process.send_signal(signal.SIGCONT)
    time.sleep(0.4)  # it hangs
    said = until_disconnected(process) if attack == "ask and never read" else ""  # the drive hangs up
    attacker.close()
    said = said or until_disconnected(process)
    stopped_s = float(re.findall(r"^stopped at ([\d.]+) s: (?:silence|connection|malformed);", said, re.MULTILINE)[-1])
    assert stopped_s - attacker.clock <= LASTS_S + 1e-3  # and then it brakes
    time.sleep(0.3)
    readings = []
    with RemoteRobot(HOST, port, certificates) as robot:
        while len(readings) < 10:
            readings.append(robot.proximal_state().devices[0][0])
            time.sleep(0.03)
    until_disconnected(process)
    assert np.ptp(readings) < NOISE_MM
    assert float(np.mean(readings)) - attacker.place <= MOST_MM
    assert attack != "ask and never read" or "it does not read the answers" in said


def test_strangers_that_wait_do_not_hold_it_up(drive, certificates) -> None:
    _, port = drive
    attacker = Attacker(port, certificates)
    with contextlib.ExitStack() as strangers:
        for number in range(60):
            stranger = strangers.enter_context(socket.create_connection((HOST, port)))
            with contextlib.suppress(OSError):  # closed already
                stranger.sendall(b"\x16\x03\x01" if number % 2 else b"STOP\n")
        begin = attacker.place
        attacker.drive(0.5)
        assert attacker.place > begin + 1.0
    attacker.close()
