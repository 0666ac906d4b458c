"""The drive attacked as a process: whatever a client sent before it hung, nothing moves for more than 200 ms after."""

from __future__ import annotations

import contextlib
import re
import signal
import socket
import subprocess
import time

import numpy as np
import pytest
from drives import HOST

from endopilot.devices.robot import RobotConfig
from endopilot.robot.drive import BRAKING_S, LASTS_S, LONGEST_LINE, tls_context
from endopilot.robot.remote import RemoteRobot

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
        self.socket = context.wrap_socket(socket.create_connection((HOST, port), timeout=5.0))
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

    def push(self, data: bytes) -> None:
        """Send without reading, until the connection takes no more for 0.5 s."""
        self.socket.settimeout(0.5)
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


def until_disconnected(process: subprocess.Popen) -> str:
    """Return what the drive reports until its client is gone."""
    return "".join(iter(process.stdout.readline, "the client has disconnected\n"))


def after_the_attack(process: subprocess.Popen, port: int, certificates, since: float) -> tuple[str, float, float]:
    """Return what the drive reported, when it stopped, s by its clock, and how far from a place, mm, it is at rest."""
    said = until_disconnected(process)
    stopped_s = float(re.findall(r"^stopped at ([\d.]+) s: (?:silence|connection|malformed);", said, re.MULTILINE)[-1])
    time.sleep(0.3)
    with RemoteRobot(HOST, port, certificates) as robot:
        readings = []
        for _ in range(10):
            readings.append(robot.proximal_state().devices[0][0])
            time.sleep(0.03)
    until_disconnected(process)
    assert np.ptp(readings) < NOISE_MM
    return said, stopped_s, float(np.mean(readings)) - since


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_moves_200_ms_after_the_client_heard_the_drive(drive, certificates, attack) -> None:
    process, port = drive
    attacker = Attacker(port, certificates)
    attacker.drive(0.3)
    attacker.ask(MOVE.strip().format(ticket=attacker.ticket))
    if held_up := "held up" in attack:
        process.send_signal(signal.SIGSTOP)
    attacker.push(ATTACKS[attack].replace("{ticket}", attacker.ticket).encode())
    if held_up:
        process.send_signal(signal.SIGCONT)
    time.sleep(0.4)  # it hangs
    attacker.close()
    said, stopped_s, moved_mm = after_the_attack(process, port, certificates, attacker.place)
    assert stopped_s - attacker.clock <= LASTS_S + 1e-3  # and then it brakes
    assert moved_mm <= MOST_MM
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
