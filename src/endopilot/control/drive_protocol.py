"""The lines that a drive and its client exchange: signed, numbered text. docs/robot.md holds the table of messages.

A line is `NUMBER VERB ARGUMENT... MAC`, fields separated by one space, at most `LONGEST_LINE` bytes with its newline.
The MAC is HMAC-SHA256 over protocol, direction, the nonce of the connection and what stands before it, so that no line
can be made without the secret, changed, sent back, or used again: numbers must grow within a connection, and no two
connections share a nonce.
"""

from __future__ import annotations

import hmac
import stat
from dataclasses import dataclass
from pathlib import Path

from endopilot.errors import InputError

PROTOCOL = "endopilot-drive 1"
"""Name and version; the drive's greeting begins with it."""
LONGEST_LINE = 200
"""Bytes of a line, newline included; a longer one is dropped."""
SHORTEST_SECRET = 16
"""Bytes of a secret, at least."""
SILENCE_S = 0.2
"""Time without a valid command after which a moving drive stops, s."""
_MAC_DIGITS, _NUMBER_DIGITS = 64, 15


@dataclass(frozen=True)
class Message:
    """What a line says.

    Attributes:
        number: of the line; a reply bears that of the line it answers.
        verb: what is asked or answered.
        arguments: the other fields.
    """

    number: int
    verb: str
    arguments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Signer:
    """Signs the lines of one connection and checks those of the other side.

    Attributes:
        secret: that both sides share.
        nonce: of the connection, drawn by the drive.
    """

    secret: bytes
    nonce: str

    def line(self, message: Message, *, of_drive: bool) -> bytes:
        """Return the signed line of a message, newline included."""
        body = " ".join([str(message.number), message.verb, *message.arguments])
        return f"{body} {self._mac(body, of_drive)}\n".encode("ascii")

    def read(self, line: bytes, *, of_drive: bool) -> Message | None:
        """Return what a line says, without its newline; None if it is malformed, too long or not signed so."""
        if len(line) >= LONGEST_LINE:
            return None
        try:
            body, _, mac = line.decode("ascii").rpartition(" ")
        except UnicodeDecodeError:
            return None
        if len(mac) != _MAC_DIGITS or not hmac.compare_digest(mac, self._mac(body, of_drive)):
            return None
        number, *fields = body.split(" ")
        if not (number.isdigit() and len(number) <= _NUMBER_DIGITS and fields):
            return None
        return Message(int(number), fields[0], tuple(fields[1:]))

    def _mac(self, body: str, of_drive: bool) -> str:
        text = "|".join([PROTOCOL, "drive" if of_drive else "client", self.nonce, body])
        return hmac.digest(self.secret, text.encode("ascii"), "sha256").hex()


def read_secret(path: Path) -> bytes:
    """Read the secret that a drive and its client share; white space around it does not count.

    Raises:
        InputError: the file is missing, is open to other users, or holds too little.
    """
    try:
        secret = path.read_bytes().strip()
        mode = path.stat().st_mode
    except OSError as error:
        raise InputError(
            f"secret: {path}: {error.strerror}; make one with `(umask 077; openssl rand -hex 32 > {path})`"
        ) from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(f"secret: {path} is open to other users; close it with `chmod 600 {path}`")
    if len(secret) < SHORTEST_SECRET:
        raise InputError(f"secret: {path} holds {len(secret)} bytes; give at least {SHORTEST_SECRET}")
    return secret
