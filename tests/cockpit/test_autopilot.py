"""A policy at the wheel: it drives to the target while time waits for it, is taken over, and fails without harm."""

from __future__ import annotations

import time
from typing import ClassVar

import pytest

from endopilot.cockpit.frames import decode
from endopilot.cockpit.messages import Autopilot, Drive
from endopilot.cockpit.session import AUTOPILOT_SILENCE_S, Session
from endopilot.errors import InputError
from endopilot.navigation.policy import BelievedTip, Decision

POLICIES = (
    "forward",
    "test_autopilot:Scripted",
    "test_autopilot:Broken",
    "test_autopilot:Slow",
    "test_autopilot:Hopeless",
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
        import numpy as np

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
def session(world, xray):
    Scripted.made.clear()
    made = Session(world, xray, None, POLICIES)
    yield made
    made.close()


def drive(session, *, until, most_s=20.0, alive=True):
    """Let cycles pass until something holds; return all messages but images."""
    sent, began = [], time.monotonic()
    now = 0.0
    while not until() and time.monotonic() - began < most_s:
        now = time.monotonic() - began
        if alive:
            session.handle(Drive(type="drive", translation=0.0, rotation=0.0), now)
        sent += [decode(message)[0] for channel, message in session.cycle(now) if not channel.startswith("image")]
        time.sleep(0.0005)
    assert until()
    return sent


def start(session, name):
    session.handle(Autopilot(type="autopilot", action="start", policy=name), 0.0)


def test_a_policy_reaches_the_target(session):
    start(session, "test_autopilot:Scripted")
    sent = drive(session, until=lambda: session.autopilot.status == "reached")
    assert abs(session.world.snapshot().tip.abscissa[0] - session.target.abscissa) <= 2.0
    seen = Scripted.made[0].seen
    assert [one.time_s for one in seen] == [0.5 * number for number in range(len(seen))]
    # X-ray is on at the first decision, and at those that follow one that asked for it.
    assert [one.tip is not None for one in seen] == [number == 0 or number % 3 == 2 for number in range(len(seen))]
    assert session.xray.frames == sum(one.tip is not None for one in seen)
    assert any(header.get("autopilot", {}).get("asks") == "it is dark" for header in sent)
    assert any(header["type"] == "belief" and header["wires_shown"] == 2 for header in sent)


def test_time_stands_still_while_a_policy_thinks(session):
    start(session, "test_autopilot:Slow")
    drive(session, until=lambda: Scripted.made and len(Scripted.made[0].seen) == 2)
    assert session.world.cycle in (40, 41)  # 0.5 s; the decision may have been taken by now


def test_a_hand_takes_over_and_hands_back(session):
    start(session, "test_autopilot:Scripted")
    drive(session, until=lambda: session.world.time_s > 0.6)
    session.handle(Drive(type="drive", translation=-5.0, rotation=0.0), 0.0)
    assert session.autopilot.status == "watches"
    policy, decisions = Scripted.made[0], len(Scripted.made[0].seen)
    for number in range(90):
        session.handle(Drive(type="drive", translation=-5.0, rotation=0.0), number * 0.0125)
        session.cycle(number * 0.0125)
        time.sleep(0.001)
    assert session.world.loop.robot.velocity[0, 0] == -5.0
    assert policy.watched >= 1 and len(policy.seen) == decisions
    start(session, "test_autopilot:Scripted")
    drive(session, until=lambda: len(policy.seen) > decisions)
    assert Scripted.made == [policy]  # it was led, and goes on
    assert policy.seen[decisions].tip is not None


def test_a_policy_that_fails_stops_the_wire(session):
    start(session, "test_autopilot:Broken")
    drive(session, until=lambda: session.autopilot.status == "failed")
    assert "no idea" in session.autopilot.failure
    assert session.values(session.world.snapshot())["command"] == (0.0, 0.0)


def test_a_policy_that_gives_up_says_why(session):
    start(session, "test_autopilot:Hopeless")
    drive(session, until=lambda: session.autopilot.status == "gave up")
    assert "at the first fork" in session.autopilot.values()["failure"]
    assert session.values(session.world.snapshot())["command"] == (0.0, 0.0)


def test_a_page_that_falls_silent_pauses_the_policy(session):
    start(session, "test_autopilot:Scripted")
    drive(session, until=lambda: session.world.time_s > 0.3)
    session.cycle(100.0)
    assert session.autopilot.status == "paused"
    for number in range(100):
        session.cycle(100.0 + AUTOPILOT_SILENCE_S + number)
    assert session.world.loop.robot.velocity[0, 0] == 0.0


def test_a_page_cannot_name_a_module(session):
    with pytest.raises(InputError, match="choose from"):
        start(session, "os:system")
