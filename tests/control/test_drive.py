"""The drive, on a clock of the test's own: whom it obeys, and when it stops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from endopilot.control.drive import Drive, _Lines
from endopilot.control.drive_protocol import LONGEST_LINE, SILENCE_S, Message, Signer, read_secret
from endopilot.control.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.simulation.drive_limits import DriveLimits

SECRET = b"0123456789abcdef"
LIMITS = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.0, travel_mm=(0.0, 100.0))
QUIET = RobotConfig(latency_s=0.0, encoder_sd_mm=0.0, encoder_sd_rad=0.0)


class Client:
    """Speaks to one session, and remembers what it sent."""

    def __init__(self, drive: Drive, secret: bytes = SECRET) -> None:
        self.drive, self.session = drive, drive.open()
        self.signer = Signer(secret, self.session.greeting.split()[-1].decode())
        self.number, self.sent = 0, []

    def say(self, verb: str, *arguments: str, now: float) -> Message | None:
        self.number += 1
        self.sent.append(self.signer.line(Message(self.number, verb, arguments), of_drive=False)[:-1])
        reply = self.session.receive(self.sent[-1], now)
        return None if reply is None else self.signer.read(reply[:-1], of_drive=True)


def moving(config: RobotConfig = QUIET) -> tuple[Drive, Client]:
    """Return a drive that goes forward at 10 mm/s since 0 s, by its own clock 1 s."""
    drive = Drive(LIMITS, SECRET, now=0.0, config=config, inserted_length=50.0)
    client = Client(drive)
    assert client.say("AUTH", now=0.0).arguments == ("40.0", "12.0", "0.0", "100.0")
    assert client.say("ARM", now=0.0).arguments[-1] == "armed"
    for now in np.arange(0.0, 1.01, 0.1):
        client.say("MOVE", "10.0", "0.5", now=float(now))
    return drive, client


def rest(drive: Drive, now: float) -> float:
    """Return where the drive comes to rest, mm, after checking that it does."""
    drive.tick(now + 0.5)
    place = drive.position[0]
    drive.tick(now + 60.0)
    assert drive.at_rest and drive.position[0] == place
    return place


def test_it_moves_as_commanded_while_commands_come() -> None:
    drive, client = moving()
    state = client.say("STATE", now=1.0)
    assert float(state.arguments[0]) == 1.0 and state.arguments[3] == "armed"
    assert float(state.arguments[1]) == pytest.approx(drive.position[0], abs=1e-4)
    assert 59.0 < drive.position[0] < 60.0


@pytest.mark.parametrize("ticks", [0.001, 5.0])  # the watchdog bites in time even where the process itself was held up
def test_silence_stops_it_within_200_ms(ticks) -> None:
    drive, client = moving()
    at = drive.position[0]
    for now in np.arange(1.0, 8.0, ticks):
        drive.tick(float(now))
    assert drive.stopped == "silence"
    # 0.2 s at 10 mm/s, then the ramp: v²/2a = 0.25 mm
    assert rest(drive, 8.0) == pytest.approx(at + 10.0 * SILENCE_S + 0.25, abs=0.02)
    # asking for the state is no command, nor is a command while it is stopped
    assert client.say("STATE", now=70.0).arguments[3] == "stopped:silence"
    assert client.say("MOVE", "10.0", "0.0", now=70.1).arguments[3] == "stopped:silence"
    drive.tick(71.0)
    assert drive.at_rest
    assert client.say("ARM", now=71.0).arguments[3] == "armed"


@pytest.mark.parametrize("verb", ["STATE", "ARM"])
def test_only_a_command_feeds_the_watchdog(verb) -> None:
    drive, client = moving()
    for now in np.arange(1.0, 1.18, 0.05):
        client.say(verb, now=float(now))
    drive.tick(1.21)
    assert drive.stopped == "silence"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("nan", "0"), "not-finite"),
        (("0", "inf"), "not-finite"),
        (("1e999", "0"), "not-finite"),
        (("40.001", "0"), "limit"),
        (("0", "-12.5"), "limit"),
    ],
)
def test_what_is_not_finite_or_beyond_the_limits_stops_it(arguments, reason) -> None:
    drive, client = moving()
    at = drive.position[0]
    assert client.say("MOVE", *arguments, now=1.0).arguments[3] == f"stopped:{reason}"
    assert rest(drive, 1.0) == pytest.approx(at + 0.25, abs=0.02)


def test_the_end_of_the_travel_stops_it_and_it_can_go_back() -> None:
    drive, client = moving()
    for now in np.arange(1.0, 8.0, 0.1):
        client.say("MOVE", "10.0", "0.0", now=float(now))
    assert drive.stopped == "travel" and drive.position[0] == 100.0
    client.say("ARM", now=8.0)
    for now in np.arange(8.0, 9.0, 0.1):
        assert client.say("MOVE", "-10.0", "0.0", now=float(now)).arguments[3] == "armed"
    assert drive.position[0] < 95.0


def test_it_stops_when_asked_and_when_the_connection_is_gone() -> None:
    drive, client = moving()
    assert client.say("STOP", now=1.0).arguments[3] == "stopped:asked"
    drive, client = moving()
    client.session.close(1.0)
    assert drive.stopped == "connection" and drive.owner is None
    rest(drive, 1.0)
    # the next client finds it stopped
    second = Client(drive)
    second.say("AUTH", now=70.0)
    assert second.say("STATE", now=70.0).arguments[3] == "stopped:connection"


def test_it_obeys_one_authenticated_client_at_a_time() -> None:
    drive, client = moving()
    other = Client(drive)
    for verb in ("ARM", "STOP", "STATE"):
        assert other.say(verb, now=1.0) is None
    assert other.say("AUTH", now=1.0).verb == "BUSY" and other.session.closed
    stranger = Client(drive, b"another secret..")
    assert stranger.say("AUTH", now=1.0) is None and stranger.say("STOP", now=1.0) is None
    assert drive.stopped is None and drive.owner is client.session
    other.session.close(1.0)
    assert drive.stopped is None


def test_replayed_changed_and_reflected_lines_are_dropped() -> None:
    drive, client = moving()
    dropped = drive.dropped
    assert all(client.session.receive(line, 1.05) is None for line in client.sent)
    assert drive.dropped == dropped + len(client.sent)
    fast = client.signer.line(Message(client.number + 1, "MOVE", ("10.0", "0.0")), of_drive=False)[:-1]
    assert client.session.receive(fast.replace(b"10.0", b"30.0"), 1.05) is None
    reply = client.signer.line(Message(client.number + 1, "STOP"), of_drive=True)[:-1]
    assert client.session.receive(reply, 1.05) is None
    # a line of another connection of the same client
    drive, again = moving()
    later = Client(drive)
    later.number = 100
    assert all(later.session.receive(line, 1.05) is None for line in again.sent)
    assert drive.stopped is None
    drive.tick(1.25)  # and none of them fed the watchdog
    assert drive.stopped == "silence"


@settings(deadline=None, max_examples=30)
@given(some.lists(some.one_of(some.binary(max_size=400), some.integers(0, 5)), max_size=20), some.data())
def test_fuzzed_lines_never_move_it_nor_break_it(pieces, data) -> None:
    drive, client = moving()
    lines = _Lines(drive)
    command = client.signer.line(Message(client.number + 1, "MOVE", ("5.0", "0.0")), of_drive=False)
    for piece in pieces:
        if isinstance(piece, int):  # a genuine line, damaged in one place
            place = data.draw(some.integers(0, len(command) - 2))
            byte = data.draw(some.integers(0, 255).filter(command[place].__ne__))
            piece = command[:place] + bytes([byte]) + command[place + 1 :]
        for line in lines.feed(piece):
            assert client.session.receive(line, 1.0) is None
        assert len(lines._held) < LONGEST_LINE
    assert drive.stopped is None and drive.owner is client.session
    # it still obeys its client afterwards
    lines.feed(b"\n")
    assert lines.feed(command) == [command[:-1]]
    assert client.session.receive(command[:-1], 1.0) is not None
    drive.tick(1.5)
    assert drive.stopped == "silence"


@given(some.lists(some.integers(0, 600), max_size=8), some.integers(1, 97))
def test_long_lines_are_left_out_however_they_are_cut(lengths, piece) -> None:
    lines = _Lines(Drive(LIMITS, SECRET, now=0.0))
    stream = b"".join(b"x" * length + b"\n" for length in lengths)
    found = [line for at in range(0, len(stream), piece) for line in lines.feed(stream[at : at + piece])]
    kept = [line for line in found if len(line) < LONGEST_LINE]
    assert kept == [b"x" * length for length in lengths if length < LONGEST_LINE]


def test_a_secret_must_be_closed_and_long(tmp_path) -> None:
    path = tmp_path / "secret"
    with pytest.raises(InputError, match="openssl"):
        read_secret(path)
    path.write_text("0123456789abcdef\n")
    path.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        read_secret(path)
    path.chmod(0o600)
    assert read_secret(path) == SECRET
    path.write_text("short")
    with pytest.raises(InputError, match="5 bytes"):
        read_secret(path)
