"""The drive, on a clock of the test's own: what it obeys, and when it stops."""

from __future__ import annotations

from collections import namedtuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.robot.drive import LONGEST_LINE, SILENCE_S, Drive, number

LIMITS = DriveLimits(max_velocity_mm_s=40.0, max_rotation_rad_s=12.0, travel_mm=(0.0, 100.0))
QUIET = RobotConfig(latency_s=0.0, wire=DriveConfig(encoder_sd_mm=0.0, encoder_sd_rad=0.0))


State = namedtuple("State", "clock inserted rotation force torque status ticket")
"""The fields of a STATE answer."""


class Client:
    """Speaks to the drive, always with the newest ticket."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.greeting = drive.open()
        self.hear(0.0)

    def hear(self, now: float) -> str:
        """Ask for the state, and return the ticket that it brings."""
        self.say("STATE", now=now)
        return self.ticket

    def say(self, verb: str, *arguments: str, now: float) -> State:
        ticket = [self.ticket] if verb in ("ARM", "MOVE") else []
        return self.send(" ".join([verb, *ticket, *arguments]), now=now)[-1]

    def send(self, *lines: str, now: float) -> list[State]:
        """Send lines in one read and return the answers."""
        data = "".join(f"{line}\n" for line in lines).encode()
        answers = [line.split(" ") for line in self.drive.receive(data, now).decode("ascii").splitlines()]
        assert len(answers) == len(lines) and all(verb == "STATE" for verb, *_ in answers)
        states = [State(*fields) for _, *fields in answers]
        self.ticket = states[-1].ticket
        return states


def moving(config: RobotConfig = QUIET, speed: str = "10.0") -> tuple[Drive, Client]:
    """Return a drive that goes forward at a speed, mm/s, since 0 s, by its own clock 1 s."""
    drive = Drive(LIMITS, now=0.0, config=config, inserted_length=20.0)
    client = Client(drive)
    assert client.say("ARM", now=0.0).status == "armed"
    for now in np.arange(0.0, 1.01, 0.1):
        client.hear(float(now))
        client.say("MOVE", speed, "0.5", now=float(now))
    return drive, client


def rest(drive: Drive, now: float) -> float:
    """Return where the drive comes to rest, mm, after checking that it does."""
    drive.tick(now + 0.5)
    place = drive.position[0]
    drive.tick(now + 60.0)
    assert drive.position[0] == place
    return place


def test_it_moves_as_commanded_while_commands_come() -> None:
    drive, client = moving()
    assert client.greeting == b"endopilot-drive 3 40.0 12.0 0.0 100.0\n"
    state = client.say("STATE", now=1.0)
    assert float(state.clock) == 1.0 and state.status == "armed"
    assert float(state.inserted) == pytest.approx(drive.position[0], abs=1e-4)
    assert 29.0 < drive.position[0] < 30.0


@pytest.mark.parametrize("ticks", [0.001, 5.0])  # the watchdog bites in time even where the process itself was held up
def test_silence_stops_it_within_200_ms(ticks) -> None:
    drive, client = moving()
    at = drive.position[0]
    for now in np.arange(1.0, 8.0, ticks):
        drive.tick(float(now))
    assert drive.stopped == "silence"
    # 0.15 s at 10 mm/s, then the ramp: v²/2a = 0.06 mm with a = 40 mm/s / 0.05 s
    at_rest = rest(drive, 8.0)
    assert at_rest == pytest.approx(at + 10.0 * 0.15 + 0.0625, abs=0.02)
    # asking for the state is no command, nor is a command while it is stopped
    assert client.say("STATE", now=70.0).status == "stopped:silence"
    assert client.say("MOVE", "10.0", "0.0", now=70.1).status == "stopped:silence"
    assert rest(drive, 70.1) == at_rest
    client.hear(140.0)
    assert client.say("ARM", now=140.0).status == "armed"


@pytest.mark.parametrize("verb", ["STATE", "ARM"])
def test_only_a_command_feeds_the_watchdog(verb) -> None:
    drive, client = moving()
    for now in np.arange(1.0, 1.18, 0.05):
        client.say(verb, now=float(now))
    drive.tick(1.21)
    assert drive.stopped == "silence"


def test_the_watchdog_counts_from_when_the_client_heard_the_drive() -> None:
    drive, client = moving()
    ticket = client.hear(1.05)
    client.send(f"MOVE {ticket} 10.0 0.0", now=1.14)  # a command that waited for 90 ms
    drive.tick(1.195)
    assert drive.stopped is None
    drive.tick(1.205)
    assert drive.stopped == "silence"


@settings(deadline=None, max_examples=60)
@given(
    some.lists(some.sampled_from(["MOVE", "MOVE", "MOVE", "ARM", "STATE", "STOP"]), min_size=1, max_size=40),
    some.lists(some.tuples(some.floats(0.0, 3.0), some.integers(1, 200)), min_size=1, max_size=12),
)
def test_a_backlog_of_any_kind_moves_it_no_longer_than_200_ms_after_its_client_hung(verbs, pieces) -> None:
    drive, client = moving(speed="40.0")
    ticket = client.hear(1.0)
    arguments = {"MOVE": f" {ticket} 40.0 0.5", "ARM": f" {ticket}"}
    backlog = "".join(f"{verb}{arguments.get(verb, '')}\n" for verb in verbs).encode()
    at = None
    arrivals = [*pieces, (SILENCE_S, 0), (3.1, len(backlog))]
    for now, length in sorted((1.0 + delay, length) for delay, length in arrivals):
        # what the network brings at some time is what the client had sent by 1 s
        drive.receive(backlog[:length], now)
        backlog = backlog[length:]
        if now == 1.0 + SILENCE_S:
            at = pytest.approx(drive.position, abs=1e-9)
    assert drive.stopped is not None and drive.position == at
    # once its client is back, the old ticket is still worth nothing
    client.send(f"ARM {ticket}", f"MOVE {ticket} 40.0 0.0", now=5.0)
    drive.tick(6.0)
    assert drive.position == at


def test_a_command_for_later_cannot_be_made() -> None:
    drive, client = moving()
    for guess in (client.ticket[::-1], "0" * 16, "", "9.9999"):
        client.send(f"MOVE {guess} 5.0 0.0", now=1.15)
    drive.tick(1.21)
    assert drive.stopped == "silence"


def test_a_stop_voids_what_was_sent_before_the_client_knew_of_it() -> None:
    for stopping in ("STOP", "MOVE {} nan 0", "MOVE {} 99 0", "nonsense"):
        drive, client = moving()
        ticket = client.hear(1.0)
        again = f"ARM {ticket}", f"MOVE {ticket} 10.0 0.0"
        states = client.send(stopping.format(ticket), *again, *again, now=1.0)
        assert all(state.status.startswith("stopped:") for state in states)
        assert rest(drive, 1.0) < 30.5
        # having heard of it, the client may arm
        drive.tick(70.0)
        client.hear(70.0)
        assert client.send(f"ARM {client.ticket}", f"MOVE {client.ticket} 10.0 0.0", now=70.0)[-1].status == "armed"
        at = drive.position
        drive.tick(70.1)
        assert drive.position != at


def test_the_newest_command_of_a_read_alone_is_obeyed() -> None:
    places = []
    for speeds in (["5.0"], ["40.0"] * 3000 + ["-40.0", "5.0"]):
        drive, client = moving(RobotConfig(latency_s=0.05))
        client.send(*(f"MOVE {client.ticket} {speed} 0.0" for speed in speeds), now=1.05)
        drive.tick(1.15)
        places.append(drive.position)
    assert places[0] == places[1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("nan", "0"), "not-finite"),
        (("0", "-Infinity"), "not-finite"),
        (("0", "inf"), "not-finite"),
        (("1e999", "0"), "not-finite"),
        (("40.001", "0"), "limit"),
        (("0", "-12.5"), "limit"),
        (("1_0", "0"), "malformed"),
        (("0", "0x1"), "malformed"),
        (("10", ""), "malformed"),
        (("10",), "malformed"),
        (("10", "0", "0"), "malformed"),
    ],
)
def test_what_is_no_number_not_finite_or_beyond_the_limits_stops_it(arguments, reason) -> None:
    drive, client = moving()
    at = drive.position[0]
    assert client.say("MOVE", *arguments, now=1.0).status == f"stopped:{reason}"
    assert rest(drive, 1.0) == pytest.approx(at + 0.0625, abs=0.02)


@settings(deadline=None)
@given(some.floats())
def test_numbers_are_read_as_they_are_written(value) -> None:
    np.testing.assert_array_equal(number(repr(value)), value)
    if np.isfinite(value):
        assert number(f"{value:+.17E}") == value


@pytest.mark.parametrize(
    "text",
    ["", "1_0", " 1", "1 ", "1\n", "+", ".", "e5", "1e", "1e5.", "0x1", "1,5", "--1", "١", "1²", "ınf", "nan()"],
)
def test_what_is_no_decimal_number_is_none(text) -> None:
    assert number(text) is None


@pytest.mark.parametrize("line", ["", "state", "STATE ", " STATE", "STATE\r", "STATE\t", "FLY", "ARM", "é", "x" * 300])
def test_a_line_that_is_not_of_the_protocol_stops_it(line) -> None:
    _, client = moving()
    assert client.send(line, now=1.0)[0].status == "stopped:malformed"
    assert client.say("STATE", now=1.0).status == "stopped:malformed"


def test_a_line_without_an_end_stops_it_and_closes_the_connection() -> None:
    drive, _ = moving()
    for _ in range(LONGEST_LINE - 1):
        assert drive.receive(b"x", 1.0) == b"" and drive.stopped is None
    assert drive.receive(b"x", 1.0) is None and drive.stopped == "malformed"


def test_the_end_of_the_travel_stops_it_and_it_can_go_back() -> None:
    drive, client = moving()
    for now in np.arange(1.0, 10.0, 0.05):
        client.say("MOVE", "10.0", "0.0", now=float(now))
    assert drive.stopped == "travel" and drive.position[0] == 100.0
    client.say("ARM", now=10.0)
    for now in np.arange(10.0, 11.0, 0.05):
        assert client.say("MOVE", "-10.0", "0.0", now=float(now)).status == "armed"
    assert drive.position[0] < 95.0


def test_it_stops_when_asked_and_when_the_connection_is_gone() -> None:
    drive, client = moving()
    assert client.say("STOP", now=1.0).status == "stopped:asked"
    drive, client = moving()
    drive.receive(b"STA", 1.0)
    drive.close(1.0)
    assert drive.stopped == "connection" and not drive.taken
    rest(drive, 1.0)
    # the next client finds it stopped, and tickets of the last one are worth nothing
    second = Client(drive)
    assert second.say("STATE", now=70.0).status == "stopped:connection"
    assert second.send(f"ARM {client.ticket}", now=70.0)[0].status == "stopped:connection"


@settings(deadline=None, max_examples=50)
@given(some.lists(some.one_of(some.binary(max_size=400), some.integers(0, 5)), min_size=1, max_size=20), some.data())
def test_fuzzed_bytes_never_move_it_nor_break_it(pieces, data) -> None:
    drive, client = moving()
    client.say("STOP", now=1.0)
    at = rest(drive, 1.0)
    command = f"MOVE {client.hear(70.0)} 5.0 0.0\n".encode()
    for piece in pieces:
        if isinstance(piece, int):  # a genuine line, damaged in one place
            place = data.draw(some.integers(0, len(command) - 2))
            byte = command[place] ^ data.draw(some.integers(1, 255))  # the ticket in it is random: draw the damage
            piece = command[:place] + bytes([byte]) + command[place + 1 :]
        drive.receive(piece, 70.0)
    drive.tick(71.0)
    assert drive.stopped is not None and drive.position[0] == at
