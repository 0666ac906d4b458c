"""A robot at the other end of a TLS connection: the client of a drive.

The drive stands still 200 ms after the caller's last command: a call alone moves the wire. `run` holds a command for
longer, while the caller waits.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from contextlib import AbstractContextManager
from pathlib import Path

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Proximals
from endopilot.errors import InputError
from endopilot.robot.drive import LONGEST_LINE, PROTOCOL, number, tls_context
from endopilot.robot.robot import ProximalState

REPEAT_S = 0.02
"""Time between two repetitions of a command in `run`, s."""
LIFE_S = 1.0
"""Time between two signs of life to the drive, s: it sends a client away of which it hears nothing for 10 s."""
ANSWER_S = 2.0
"""Time that the drive has to answer, s."""


class RemoteRobot(AbstractContextManager["RemoteRobot"]):
    """Commands a drive process, and reads its encoders, which sit at the motor, and its load. Any thread may call it.
    A call raises InputError once the connection is lost. No command beyond the `limits` that the drive reported is ever
    sent; `status` is "armed", or "stopped:" and why, as the drive last said."""

    def __init__(self, host: str, port: int, certificates: Path) -> None:
        """Connect and arm the drive, with `client.key`, `client.crt` and `drive.crt` of a folder. InputError where a
        file is missing or bad, nothing listens there, or what does is another drive, does not know this client, or has
        one."""
        self._where, self._lock = f"{host}:{port}", threading.RLock()
        self._lost, self.status = "", "stopped:start"
        self._ticket, self._wanted, self._closing = "", (0.0, 0.0), threading.Event()
        self._socket = self._connect(host, port, Path(certificates))
        self._lines = self._socket.makefile("rb")
        try:
            self.limits = self._greet(Path(certificates))
            self.arm()
        except BaseException:
            self._lose("it was refused")
            raise
        self._living = threading.Thread(target=self._live, daemon=True)
        self._living.start()

    def __exit__(self, *error: object) -> None:
        """Close the connection, which stops the drive."""
        self.close()

    def command(self, devices: Proximals) -> Proximals:
        """Move on for 200 ms at most, and return what is made of it, as `Robot` says; the drive moves a wire alone.

        A drive that stopped because it heard no command in time is armed again; after any other stop `arm` must.
        """
        translation, rotation = devices[0] if devices else (0.0, 0.0)
        with self._lock:
            self._wanted = self.limits.safe(translation, rotation)
            self._move()
            return (self._wanted,)

    def run(self, duration: float) -> None:
        """Hold the last command for some time, s, at the end of which this returns."""
        until = time.monotonic() + duration
        while (left := until - time.monotonic()) > 0:
            self._move()
            time.sleep(min(REPEAT_S, left))

    def proximal_state(self) -> ProximalState:
        """Return what the drive measures now."""
        return self._ask("STATE")

    def arm(self) -> None:
        """Let a drive that stopped move again, at the next command."""
        with self._lock:
            self._wanted = (0.0, 0.0)
            self._ask("STATE")  # a stop that this client has not heard of made its ticket void
            self._ask("ARM", self._ticket)

    def stop(self) -> None:
        """Stop the drive until it is armed again."""
        with self._lock:
            self._wanted = (0.0, 0.0)
            self._ask("STOP")

    def close(self) -> None:
        """Close the connection; the drive stops."""
        self._closing.set()
        with self._lock:
            self._lose("it was closed")
        self._living.join()

    def _connect(self, host: str, port: int, certificates: Path) -> ssl.SSLSocket:
        context = tls_context(certificates, of_drive=False)
        try:
            plain = socket.create_connection((host, port), timeout=ANSWER_S)
        except (OSError, OverflowError, UnicodeError) as error:
            raise InputError(
                f"host, port: no drive at {self._where} ({error}); start one, `endopilot drive`"
            ) from error
        try:
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return context.wrap_socket(plain)
        except ssl.SSLCertVerificationError as error:
            raise InputError(
                f"certificates: the drive at {self._where} is not that of {certificates / 'drive.crt'} "
                f"({error.verify_message}); copy its drive.crt there"
            ) from error
        except OSError as error:
            raise InputError(
                f"host, port: {self._where} begins no TLS 1.3 ({error}); check the address, or try again if too many "
                "connections wait there"
            ) from error

    def _greet(self, certificates: Path) -> DriveLimits:
        """Read the drive's greeting and return its limits."""
        try:
            greeting = self._line()
        except OSError as error:  # in TLS 1.3 a client learns so late that it was refused
            raise InputError(
                f"certificates: the drive at {self._where} closed the connection ({error}); "
                f"copy {certificates / 'client.crt'} into its folder and start it again"
            ) from error
        if greeting == f"{PROTOCOL} BUSY":
            raise InputError(f"host, port: the drive at {self._where} has another client; disconnect that first")
        name, *fields = greeting.rsplit(" ", 4)
        numbers = [value for value in map(number, fields) if value is not None]
        if name != PROTOCOL or len(numbers) != 4:
            raise InputError(f"host, port: {self._where} speaks no {PROTOCOL}; check the address and the version")
        speed, spin, low, high = numbers
        return DriveLimits(max_velocity_mm_s=speed, max_rotation_rad_s=spin, travel_mm=(low, high))

    def _move(self) -> None:
        with self._lock:
            self._ask("STATE")  # for a new ticket
            if self.status == "stopped:silence":
                self._ask("ARM", self._ticket)
            self._ask("MOVE", self._ticket, *(repr(value) for value in self._wanted))

    def _live(self) -> None:
        while not self._closing.wait(LIFE_S):
            try:
                self._ask("STATE")
            except InputError:
                return  # the next call of the controller says so

    def _ask(self, verb: str, *arguments: str) -> ProximalState:
        """Send a line and return what the drive answers; with the connection lost it stays so."""
        with self._lock:
            if self._lost:
                raise self._gone()
            try:
                self._socket.sendall(" ".join([verb, *arguments]).encode("ascii") + b"\n")
                fields = self._line().split(" ")
                values = [value for value in map(number, fields[1:6]) if value is not None]
                if fields[0] != "STATE" or len(fields) != 8 or len(values) != 5:
                    raise ConnectionError("its answer is not of the protocol")
            except OSError as error:
                self._lose(str(error))
                raise self._gone() from error
            except BaseException:  # Ctrl-C between question and answer: the next answer would be that of this question
                self._lose("a question was interrupted")
                raise
            self.status, self._ticket = fields[6:]
            clock, inserted, rotation, force, torque = values
            return ProximalState(clock, ((inserted, rotation),), ((force, torque),))

    def _lose(self, reason: str) -> None:
        self._lost = self._lost or reason
        self._lines.close()  # a socket stays open as long as a file on it
        self._socket.close()

    def _gone(self) -> InputError:
        return InputError(f"drive at {self._where}: the connection is lost ({self._lost}); connect again")

    def _line(self) -> str:
        """Return the next line, without its newline."""
        line = self._lines.readline(LONGEST_LINE)
        if not line.endswith(b"\n"):
            raise ConnectionError("closed by the drive" if len(line) < LONGEST_LINE else "its line is too long")
        return line[:-1].decode("ascii", "replace")
