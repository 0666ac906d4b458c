"""A session: the wire moves by messages, stops by itself, is counted and recorded, and replays to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.cockpit.frames import decode
from endopilot.cockpit.messages import Contrast, Drive, Pedal, Target
from endopilot.cockpit.recording import Recorder, read_session
from endopilot.cockpit.session import HICCUP_S
from endopilot.errors import InputError


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
    plane = session.xray._planes[session.xray.settings.planes[0]]
    vessel = plane.vessel_mm > 1.0
    wire = session.xray._imager.wire(plane, session.world.snapshot().nodes) > 0.4
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


def test_a_session_of_an_older_version_says_which(tmp_path):
    path = tmp_path / "x.cockpit.jsonl"
    path.write_text('{"format": "endopilot cockpit 1", "version": "0.0.9"}\n')
    with pytest.raises(InputError, match=r"a session of endopilot 0\.0\.9, whose loop differs; replay it with that"):
        read_session(path)


@pytest.mark.parametrize("text", ["", "{}\n", "nonsense\n", '{"format": "endopilot cockpit 2"}\n'])
def test_what_is_no_session_is_told(tmp_path, text):
    path = tmp_path / "x.cockpit.jsonl"
    path.write_text(text)
    with pytest.raises(InputError, match="session"):
        read_session(path)
