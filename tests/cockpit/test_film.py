"""What can be replayed is driven again and shown frame by frame."""

from __future__ import annotations

import time

import numpy as np
import pytest

from endopilot.cockpit.film import ReplayStage, open_film
from endopilot.cockpit.frames import decode
from endopilot.cockpit.messages import Drive, Pedal, Replay, Target
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.tasks.task import find_task


def driven(film, *, start=True):
    if start:
        film.start()
    until = time.monotonic() + 60
    while not film.done and time.monotonic() < until:
        time.sleep(0.01)
    assert film.done and not film.failure
    return film


def test_a_session_is_shown_as_it_was(session, tmp_path):
    seen = {}
    for number in range(120):
        if number % 4 == 0:
            session.handle(Drive(type="drive", translation=15.0, rotation=3.0), number * 0.0125)
        if number == 60:
            session.handle(Pedal(type="pedal", down=True), number * 0.0125)
        sent = session.cycle(number * 0.0125)
        header, arrays = decode(dict(sent)["state"])
        seen[header["cycle"]] = arrays["nodes"]
    session.close()
    film = driven(open_film(tmp_path / "a.cockpit.jsonl"))
    assert film.seconds == 1.5 and len(film.frames) == 31
    for frame in film.frames[1:]:
        np.testing.assert_array_equal(frame.snapshot.nodes.astype("<f4"), seen[frame.snapshot.cycle])
    shown = [frame.snapshot.time_s for frame in film.frames if frame.exposed]
    assert shown[0] == pytest.approx(0.8, abs=0.051) and len(shown) == session.xray.frames


@pytest.mark.parametrize("version", [1, 2])
def test_a_navigation_of_the_ladder_is_the_same_to_the_bit(tmp_path, version):
    task = find_task("straight", version=version)
    result = attempt("forward", task.ladder_navigation(0), seed=navigation_seed(task, 0))
    of_version = {} if version == 1 else {"ladder": version}  # as files were before there was a version 2
    write_json(tmp_path / "straight" / "00.json", of_version | result)
    film = driven(open_film(tmp_path / "straight" / "00.json"))
    tips = np.array([frame.snapshot.nodes[0] for frame in film.frames[::10]])
    np.testing.assert_array_equal(tips.round(3), np.array(result["course"]["tip_position"]))
    assert film.frames[-1].peak_n == pytest.approx(result["peak_force_n"], abs=1e-9)
    assert [frame.exposed for frame in film.frames].count(True) == result["exposures"]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "x.txt").write_text("")
    write_json(tmp_path / "y.json", {"a": 1})
    for name in ("x.txt", "y.json"):
        with pytest.raises(InputError):
            open_film(tmp_path / name)


def test_a_replay_plays_pauses_and_seeks(session, xray, tmp_path):
    for number in range(120):
        if number % 4 == 0:
            session.handle(Drive(type="drive", translation=15.0, rotation=3.0), number * 0.0125)
        session.cycle(number * 0.0125)
    session.close()
    stage = ReplayStage(open_film(tmp_path / "a.cockpit.jsonl"), xray)
    driven(stage.film, start=False)
    times = [decode(dict(stage.cycle(0.0))["state"])[0]["time_s"] for _ in range(5)]
    np.testing.assert_allclose(times, [0, 0.05, 0.1, 0.15, 0.2])
    stage.handle(Replay(type="replay", playing=False, at_s=1.0), 0.0)
    header, arrays = decode(dict(stage.cycle(0.0))["state"])
    assert header["time_s"] == 1.0 and header["replay"]["seconds"] == 1.5 and len(arrays["nodes"]) > 10
    assert decode(dict(stage.cycle(0.0))["state"])[0]["time_s"] == 1.0
    stage.handle(Replay(type="replay", at_s=1e6, playing=True), 0.0)
    stage.cycle(0.0)
    assert not stage.playing
    with pytest.raises(InputError, match="not in a replay"):
        stage.handle(Target(type="target", branch=0, abscissa=1.0), 0.0)
