"""A session: a hand that drives, and a policy that takes over."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
import pytest

from endopilot.cockpit.frames import decode
from endopilot.cockpit.messages import Autopilot, Contrast, Drive, Pedal, Target
from endopilot.cockpit.recording import Recorder, read_session
from endopilot.cockpit.session import AUTOPILOT_SILENCE_S, HICCUP_S, Session
from endopilot.errors import InputError
from endopilot.navigation.policy import BelievedTip, Decision


def run(session, seconds, *, message=None, start=0.0):
    """Run for some time of the world, repeating a message every 50 ms, and return the last state and all images."""
    cycle, images, state = session.world.config.cycle_s, [], None
    for number in range(round(seconds / cycle)):
        now = start + number * cycle
        if message is not None and number % 4 == 0:
            session.handle(message, now)
        sent = dict(session.cycle(now))
        state = decode(sent.pop("state"))
        images += [decode(image) for image in sent.values()]
    return state, images


def test_the_wire_follows_the_drive_within_its_limits(session):
    before = session.world.snapshot().inserted_length_mm
    (header, arrays), _ = run(session, 1.0, message=Drive(type="drive", translation=900.0, rotation=0.0))
    fastest = session.world.navigation.device.max_velocity_mm_s
    assert header["command"] == [fastest, 0.0]
    # 50 ms of latency and a ramp of 40/200 s: the rest at full speed; what the drive slips over is lost.
    assert 10 < header["inserted_length_mm"] - before <= fastest * (1.0 - 0.05 - 0.1)
    assert np.isfinite(arrays["nodes"]).all() and len(arrays["nodes"]) == len(arrays["node_force"])


def test_a_hand_that_was_silent_for_long_must_let_go_first(session):
    drive, pedal = Drive(type="drive", translation=5.0, rotation=0.0), Pedal(type="pedal", down=True)
    session.handle(drive, 0.0)
    session.handle(pedal, 0.0)
    run(session, HICCUP_S + 0.1)
    frames = session.xray.frames
    (header, _), _ = run(session, 0.3, message=drive, start=HICCUP_S + 0.1)
    session.handle(pedal, 1.0)
    run(session, 0.15, start=1.0)
    assert header["velocity"] == [0.0, 0.0] and not session.xray.pedal and session.xray.frames == frames
    assert header["stopped"] == "silence"
    session.handle(Drive(type="drive", translation=0.0, rotation=0.0), 1.2)
    session.handle(Pedal(type="pedal", down=False), 1.2)
    session.handle(pedal, 1.2)
    (header, _), _ = run(session, 0.3, message=drive, start=1.2)
    assert header["velocity"] == [5.0, 0.0] and session.xray.pedal and header["stopped"] == ""


def test_after_a_hiccup_what_is_held_goes_on(session):
    drive, pedal = Drive(type="drive", translation=5.0, rotation=0.0), Pedal(type="pedal", down=True)
    session.handle(drive, 0.0)
    session.handle(pedal, 0.0)
    (header, _), _ = run(session, HICCUP_S - 0.1)
    assert header["velocity"] == [0.0, 0.0] and not session.xray.pedal
    session.handle(pedal, HICCUP_S - 0.08)
    (header, _), _ = run(session, 0.15, message=drive, start=HICCUP_S - 0.08)
    assert header["velocity"][0] > 0.0 and header["stopped"] == "" and session.xray.pedal


def test_the_pedal_counts_and_silence_lets_it_go(session):
    _, images = run(session, 1.0, message=Pedal(type="pedal", down=True))
    assert len(images) == session.xray.frames == 8  # at 0, 1/7.5, ... 7/7.5 s
    assert session.xray.kerma_ugy > 0
    run(session, 0.5, start=1.0)
    held = session.xray.frames
    run(session, 0.5, start=1.5)
    assert not session.xray.pedal and session.xray.frames == held


def test_x_ray_shows_the_wire_and_contrast_the_vessel(session):
    run(session, 0.6, message=Drive(type="drive", translation=20.0, rotation=0.0))
    session.handle(Drive(type="drive", translation=0.0, rotation=0.0), 0.6)
    _, plain = run(session, 0.3, message=Pedal(type="pedal", down=True), start=0.6)
    session.handle(Contrast(type="contrast"), 1.0)
    _, lit = run(session, 0.6, message=Pedal(type="pedal", down=True), start=1.0)
    plane = session.xray.plane(session.xray.settings.planes[0])
    vessel = plane.vessel_mm > 1.0
    wire = session.xray.imager.wire(plane, session.world.snapshot().nodes) > 0.4
    grey = plain[-1][1]["grey"].astype(float)
    assert vessel.sum() > 100 and wire.sum() > 10
    assert grey[wire].mean() < grey[~wire & ~vessel].mean() - 20
    assert lit[-1][1]["grey"][vessel].mean() < grey[vessel].mean() - 20


def test_a_target_is_a_section_or_a_place(session):
    session.handle(Target(type="target", branch=0, abscissa=12.0), 0.0)
    assert (session.target.branch, session.target.abscissa) == (0, 12.0)
    for wrong in (
        Target(type="target", section="none"),
        Target(type="target", branch=99, abscissa=1.0),
        Target(type="target"),
    ):
        with pytest.raises(InputError):
            session.handle(wrong, 0.0)
    assert session.target.abscissa == 12.0


def test_an_event_that_would_take_days_to_reach_is_refused(session, tmp_path):
    run(session, 0.5, message=Drive(type="drive", translation=10.0, rotation=1.0))
    session.close()
    path = tmp_path / "a.cockpit.jsonl"
    with path.open("a") as stream:
        stream.write('{"at": 1000000000, "stop": true}\n')
    with pytest.raises(InputError, match=r"a\.cockpit\.jsonl: 9999999\d\d cycles without a check"):
        read_session(path)


def test_a_recording_that_cannot_be_written_is_told(world, vessel, tmp_path):
    from endopilot.cockpit.recording import Where

    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        Recorder(tmp_path / "file" / "a.jsonl", world, Where(patient=vessel), 0)


OLDER = '{"format": "endopilot cockpit 1", "version": "0.0.9"}\n'


@pytest.mark.parametrize("text", ["", "{}\n", "nonsense\n", '{"format": "endopilot cockpit 2"}\n', OLDER])
def test_what_is_no_session_of_this_version_is_told(tmp_path, text):
    path = tmp_path / "x.cockpit.jsonl"
    path.write_text(text)
    said = "a session of endopilot 0.0.9, whose loop differs; replay it with that" if text == OLDER else "session"
    with pytest.raises(InputError, match=said):
        read_session(path)


POLICIES = (
    "forward",
    "test_session:Scripted",
    "test_session:Broken",
    "test_session:Slow",
    "test_session:Hopeless",
)


class Scripted:
    """Pushes, asks for X-ray at every third decision, and can be led."""

    made: ClassVar[list] = []

    def start(self, navigation, seed):
        self.navigation, self.seen, self.watched = navigation, [], 0
        Scripted.made.append(self)

    def decide(self, observation):
        self.seen.append(observation)
        return Decision(((10.0, 0.0),), expose=len(self.seen) % 3 == 2)

    def watch(self, observation):
        self.watched += 1

    def believed(self):
        return BelievedTip(3.0, 0.1, (1.0, 0.2), asks="it is dark" if len(self.seen) % 3 == 2 else "")

    def believed_wires(self):
        return np.zeros((2, 5, 3))


class Broken(Scripted):
    def decide(self, observation):
        raise ValueError("no idea")


class Hopeless(Scripted):
    def decide(self, observation):
        return Decision(((1.0, 0.0),), gives_up="at the first fork")


class Slow(Scripted):
    def decide(self, observation):
        time.sleep(0.3)
        return super().decide(observation)


@pytest.fixture
def driven(world, xray, recorded):
    Scripted.made.clear()
    made = Session(world, xray, recorded(world), POLICIES)
    yield made
    made.close()


def drive(driven, *, until, most_s=20.0):
    """Let cycles pass until something holds; return all messages but images."""
    sent, began = [], time.monotonic()
    while not until() and time.monotonic() - began < most_s:
        now = time.monotonic() - began
        driven.handle(Drive(type="drive", translation=0.0, rotation=0.0), now)
        sent += [decode(message)[0] for channel, message in driven.cycle(now) if not channel.startswith("image")]
        time.sleep(0.0005)
    assert until(), driven.autopilot.values()
    return sent


def start(driven, name):
    driven.handle(Autopilot(type="autopilot", action="start", policy=name), 0.0)


def test_a_policy_reaches_the_target(driven):
    start(driven, "test_session:Scripted")
    sent = drive(driven, until=lambda: driven.autopilot.status == "reached")
    assert abs(driven.world.snapshot().tip.abscissa[0] - driven.target.abscissa) <= 2.0
    seen = Scripted.made[0].seen
    assert [one.time_s for one in seen] == [0.5 * number for number in range(len(seen))]
    # X-ray is on at the first decision, and at those that follow one that asked for it.
    assert [one.tip is not None for one in seen] == [number == 0 or number % 3 == 2 for number in range(len(seen))]
    assert driven.xray.frames == sum(one.tip is not None for one in seen)
    assert any(header.get("autopilot", {}).get("asks") == "it is dark" for header in sent)
    assert any(header["type"] == "belief" and header["wires_shown"] == 2 for header in sent)


def test_time_stands_still_while_a_policy_thinks(driven):
    start(driven, "test_session:Slow")
    drive(driven, until=lambda: Scripted.made and len(Scripted.made[0].seen) == 2)
    assert driven.world.cycle in (40, 41)  # 0.5 s; the decision may have been taken by now


def test_a_hand_takes_over_and_hands_back(driven):
    start(driven, "test_session:Scripted")
    drive(driven, until=lambda: driven.world.time_s > 0.6)
    driven.handle(Drive(type="drive", translation=-5.0, rotation=0.0), 0.0)
    assert driven.autopilot.status == "watches"
    policy, decisions = Scripted.made[0], len(Scripted.made[0].seen)
    for number in range(90):
        driven.handle(Drive(type="drive", translation=-5.0, rotation=0.0), number * 0.0125)
        driven.cycle(number * 0.0125)
        time.sleep(0.001)
    assert driven.world.loop.robot.velocity[0, 0] == -5.0
    assert policy.watched >= 1 and len(policy.seen) == decisions
    start(driven, "test_session:Scripted")
    drive(driven, until=lambda: len(policy.seen) > decisions)
    assert Scripted.made == [policy]  # it was led, and goes on
    assert policy.seen[decisions].tip is not None


@pytest.mark.parametrize(
    ("policy", "status", "why"), [("Broken", "failed", "no idea"), ("Hopeless", "gave up", "at the first fork")]
)
def test_a_policy_that_fails_or_gives_up_says_why_and_the_wire_stops(driven, policy, status, why):
    start(driven, f"test_session:{policy}")
    drive(driven, until=lambda: driven.autopilot.status == status)
    assert why in driven.autopilot.values()["failure"]
    assert driven.values(driven.world.snapshot())["command"] == (0.0, 0.0)


def test_a_page_that_falls_silent_pauses_the_policy(driven):
    start(driven, "test_session:Scripted")
    drive(driven, until=lambda: driven.world.time_s > 0.3)
    driven.cycle(100.0)
    assert driven.autopilot.status == "paused"
    for number in range(100):
        driven.cycle(100.0 + AUTOPILOT_SILENCE_S + number)
    assert driven.world.loop.robot.velocity[0, 0] == 0.0


def test_a_page_cannot_name_a_module(driven):
    with pytest.raises(InputError, match="choose from"):
        start(driven, "os:system")
