"""The lines that a drive and its client exchange, and the certificates by which they know each other.

docs/concepts/drive-protocol.md holds the table of messages. A line is ASCII text, `VERB ARGUMENT...`, fields separated
by one space, at most `LONGEST_LINE` bytes with its newline. Lines travel over TLS 1.3, and each side trusts one
certificate, that of the other: so nobody else can read a line, make one, change it or send it again.
"""

from __future__ import annotations

import re
import shlex
import ssl
import stat
from pathlib import Path

from endopilot.errors import InputError

PROTOCOL = "endopilot-drive 3"
"""Name and version; the drive's greeting begins with it."""
LONGEST_LINE = 200
"""Bytes of a line, newline included."""
SILENCE_S = 0.2
"""Time after which a drive stands still whose client has not heard it since, s."""
BRAKING_S = 0.05
"""Time in which the drive brakes from its top speeds, s (an assumption): a ticket lasts that much less."""
_NUMBER = re.compile(
    r"[+-]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)


def number(text: str) -> float | None:
    """Return the number that a field holds, in decimal digits, NaN or infinite; None for anything else.

    Python's own `float` also takes underscores, white space and the digits of other scripts.
    """
    return float(text) if _NUMBER.fullmatch(text) else None


def tls_context(folder: Path, *, of_drive: bool) -> ssl.SSLContext:
    """Return the TLS settings of one side: its own key and certificate, and the one certificate that it trusts.

    Args:
        folder: holds PEM files: `drive.key`, `drive.crt` and `client.crt` for the drive; `client.key`, `client.crt` and
            `drive.crt` for the client.
        of_drive: for the drive, or for its client.

    Raises:
        InputError: a file is missing or holds something else; the key is encrypted, open to others, or of another
            certificate.
    """
    side, other = ("drive", "client") if of_drive else ("client", "drive")
    key, own, trusted = folder / f"{side}.key", folder / f"{side}.crt", folder / f"{other}.crt"
    for path in (key, own, trusted):
        if not path.is_file():
            raise InputError(
                f"certificates: {path}: no such file; copy it there, or make both sides' with `{_recipe(folder)}`"
            )
    if key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(f"certificates: {key} is open to other users; close it with `chmod 600 {key}`")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if of_drive else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the certificate itself is known, whatever name it bears
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    try:
        context.load_cert_chain(own, key, password=lambda: "")  # an encrypted key would ask at the terminal
    except OSError as error:
        raise InputError(
            f"certificates: {own} and {key} are no certificate and its unencrypted key ({_reason(error)}); "
            f"make both sides' with `{_recipe(folder)}`"
        ) from error
    try:
        context.load_verify_locations(trusted)
    except OSError as error:
        raise InputError(
            f"certificates: {trusted} holds no certificate ({_reason(error)}); copy the {other}'s there"
        ) from error
    return context


def _recipe(folder: Path) -> str:
    """Return the shell command that makes a folder with the keys and certificates of both sides."""
    place = shlex.quote(str(folder))
    request = (
        "openssl req -x509 -newkey rsa:3072 -nodes -days 3650 -subj /CN=$side "
        f"-keyout {place}/$side.key -out {place}/$side.crt"
    )
    return f"mkdir -p {place}; for side in drive client; do {request}; done"


def _reason(error: OSError) -> str:
    return str(getattr(error, "reason", None) or error.strerror or error)
