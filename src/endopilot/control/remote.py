"""A robot at the other end of a TCP connection: the client of a drive.

The drive stops where no command comes for 0.2 s, and a controller decides every 0.5 s; so a thread repeats the last
command in between. It does so for a while only: where the controller itself falls silent, so does the client, and the
drive stops.
"""

from __future__ import annotations

import socket
import threading
import time
from types import TracebackType

from endopilot.control.drive_protocol import LONGEST_LINE, PROTOCOL, Message, Signer
from endopilot.control.robot import ProximalState
from endopilot.errors import InputError
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.tasks.navigation import DECISION_PERIOD_S

REPEAT_S = 0.05
"""Time between two repetitions of a command, s."""
HOLD_S = 1.5 * DECISION_PERIOD_S
"""Time for which a command is repeated, s."""
ANSWER_S = 2.0
"""Time that the drive has to answer, s."""


class RemoteRobot:
    """Commands a drive process, and reads its encoders.

    Attributes:
        limits: of the drive, as it reported them; no command beyond them is ever sent.
        status: "armed", or "stopped:" and why, as the drive last said.
    """

    def __init__(self, host: str, port: int, secret: bytes) -> None:
        """Connect, authenticate and arm the drive.

        Args:
            host: where the drive listens.
            port: its TCP port.
            secret: shared with it.

        Raises:
            InputError: nothing listens there, it is no drive, it has another secret, or another client.
        """
        self._where, self._lock, self._number = f"{host}:{port}", threading.Lock(), 0
        try:
            self._socket = socket.create_connection((host, port), timeout=ANSWER_S)
        except OSError as error:
            raise InputError(
                f"host, port: no drive at {self._where} ({error}); start one, `endopilot drive`"
            ) from error
        self._held, self.status = b"", "stopped:start"
        try:
            name, _, nonce = self._line().decode("ascii", "replace").rpartition(" ")
            if name != PROTOCOL:
                raise InputError(f"host, port: {self._where} speaks no {PROTOCOL}; check the address and the version")
            self._signer = Signer(secret, nonce)
            self.limits = self._authenticate()
            self._ask("ARM")
        except BaseException:
            self._socket.close()
            raise
        self._wanted, self._until, self._open = (0.0, 0.0), 0.0, True
        self._repeater = threading.Thread(target=self._repeat, daemon=True)
        self._repeater.start()

    def __enter__(self) -> RemoteRobot:
        """Return the robot; leaving the block stops it and closes the connection."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the connection."""
        self.close()

    def command(self, translation: float, rotation: float) -> None:
        """Move on at a velocity, mm/s and rad/s, for `HOLD_S` at most. What is not finite stops the wire.

        Raises:
            InputError: the connection is lost.
        """
        self._wanted, self._until = self.limits.safe(translation, rotation), time.monotonic() + HOLD_S
        self._send_wanted()

    def proximal_state(self) -> ProximalState:
        """Return what the drive's encoders say now.

        Raises:
            InputError: the connection is lost.
        """
        return self._ask("STATE")

    def arm(self) -> None:
        """Let a drive that stopped move again.

        Raises:
            InputError: the connection is lost.
        """
        self._ask("ARM")

    def stop(self) -> None:
        """Stop the drive until it is armed again.

        Raises:
            InputError: the connection is lost.
        """
        self._until = 0.0
        self._ask("STOP")

    def close(self) -> None:
        """Close the connection; the drive stops."""
        self._open = False
        self._socket.close()

    def _authenticate(self) -> DriveLimits:
        reply = self._exchange("AUTH", secret_known=False)
        if reply.verb == "BUSY":
            raise InputError(f"host, port: the drive at {self._where} has another client; disconnect that first")
        speed, spin, low, high = (float(number) for number in reply.arguments)
        return DriveLimits(max_velocity_mm_s=speed, max_rotation_rad_s=spin, travel_mm=(low, high))

    def _send_wanted(self) -> None:
        self._ask("MOVE", *(repr(number) for number in self._wanted))

    def _repeat(self) -> None:
        while self._open:
            time.sleep(REPEAT_S)
            if self._open and time.monotonic() < self._until:
                try:
                    self._send_wanted()
                except (InputError, OSError):
                    return  # the next call of the controller says so

    def _ask(self, verb: str, *arguments: str) -> ProximalState:
        clock, inserted, rotation, self.status = self._exchange(verb, *arguments).arguments
        return ProximalState(float(clock), float(inserted), float(rotation))

    def _exchange(self, verb: str, *arguments: str, secret_known: bool = True) -> Message:
        """Send a message and return its reply."""
        with self._lock:
            self._number += 1
            try:
                self._socket.sendall(self._signer.line(Message(self._number, verb, arguments), of_drive=False))
                reply = self._signer.read(self._line(), of_drive=True)
            except OSError as error:
                hint = "the connection is lost" if secret_known else "it does not answer; check the secret"
                raise InputError(f"drive at {self._where}: {hint} ({error})") from error
            if reply is None or reply.number != self._number:
                raise InputError(f"drive at {self._where}: an answer is not the drive's; check the secret")
            return reply

    def _line(self) -> bytes:
        """Return the next line, without its newline."""
        while b"\n" not in self._held:
            data = self._socket.recv(4096)
            if not data or len(self._held) > 10 * LONGEST_LINE:
                raise ConnectionError("closed by the drive")
            self._held += data
        line, _, self._held = self._held.partition(b"\n")
        return line
