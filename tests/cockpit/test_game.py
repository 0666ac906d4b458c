"""A task driven by hand and scored, and films of what was recorded."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from browser import ready, shown

from endopilot.cockpit import game
from endopilot.cockpit.film import ReplayStage, open_film
from endopilot.cockpit.frames import decode
from endopilot.cockpit.game import Attempt, GameSession
from endopilot.cockpit.messages import Autopilot, Drive, Game, Pedal, Replay, Target
from endopilot.cockpit.open import resume_session
from endopilot.cockpit.recording import Recorder, Where
from endopilot.cockpit.session import Session
from endopilot.cockpit.world import LiveWorld
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.ladder.attempt import attempt, navigation_seed
from endopilot.tasks.task import find_task

HIDDEN = {"tip_mm", "section", "force_n", "peak_force_n"}


class Rival:
    """In place of the process in which the agent drives."""

    def __init__(self, *arguments, **more):
        pass

    def submit(self, function, tried):
        from concurrent.futures import Future

        future = Future()
        future.set_result({"success": True})
        return future

    def stop(self):
        pass


@pytest.fixture
def played(navigation, xray, recorded):
    world = LiveWorld(replace(navigation, seconds=6.0, force_limit_n=0.3))
    with patch.object(game, "Workers", Rival):
        made = GameSession(Attempt(find_task("straight"), 0), world, xray, recorded(world))
        yield made
        made.close()


def play(session, message, seconds, *, until_over=False):
    last = {}
    for number in range(round(seconds / session.world.config.cycle_s)):
        if until_over and session.phase == "over":
            break
        now = number * session.world.config.cycle_s
        if message is not None and number % 4 == 0:
            session.handle(message, now)
        last |= {channel: decode(sent) for channel, sent in session.cycle(now)}
    return last


def test_nothing_moves_before_the_clock_starts(played):
    last = play(played, Drive(type="drive", translation=10.0, rotation=0.0), 0.5)
    assert played.world.cycle == 0 and last["state"][0]["game"]["phase"] == "waits"


def test_only_x_ray_shows_the_wire(played):
    played.handle(Game(type="game", action="start"), 0.0)
    last = play(played, Pedal(type="pedal", down=True), 0.5)
    header, arrays = last["state"]
    assert not HIDDEN & set(header) and not arrays
    assert last["image0"][1]["grey"].shape == (512, 512)
    for message in (
        Target(type="target", branch=0, abscissa=1.0),
        Autopilot(type="autopilot", action="start", policy="oracle"),
    ):
        with pytest.raises(InputError, match="not before the end"):
            played.handle(message, 0.0)


def test_it_is_scored_by_the_ladders_code(played):
    played.handle(Game(type="game", action="start"), 0.0)
    play(played, Pedal(type="pedal", down=True), 0.4)
    played.handle(Pedal(type="pedal", down=False), 0.0)
    last = play(played, Drive(type="drive", translation=5.0, rotation=1.0), 3.0)
    assert played.phase == "over"
    you = last["result"][0]["scores"]["you"]
    assert you["success"] and you["reason"] == "reached"
    assert you["seconds"] % 0.5 == 0 and 1.5 <= you["seconds"] <= 4.0
    assert you["exposures"] == played.xray.frames > 0
    assert set(last["state"][0]) >= HIDDEN and len(last["state"][1]["nodes"]) > 10
    assert last["result"][0]["scores"]["agent"] == {"success": True}


def test_the_time_ends_it(played):
    played.handle(Game(type="game", action="start"), 0.0)
    last = play(played, None, 6.1)
    you = last["result"][0]["scores"]["you"]
    assert (you["success"], you["reason"], you["seconds"], you["exposures"]) == (False, "time", 6.0, 0)


def test_a_task_has_the_ladders_world():
    tried = Attempt(find_task("straight"), 1)
    world = tried.world()
    ladder = tried.task.ladder_navigation(1)
    assert world.navigation.anatomy.identity == ladder.anatomy.identity
    assert world.config.simulator.element_mm == 1.25
    assert np.isclose(world.snapshot().rotation, ladder.start_rotation_rad)


def test_a_killed_game_goes_on_and_is_scored_as_if_it_had_not_been(tmp_path, xray):
    """Half the drive, the server killed, and the other half: the same figures as in one go."""
    tried = Attempt(find_task("straight"), 0, read_robot("kweon-2021-3d"))
    scores = {}
    with patch.object(game, "Workers", Rival):
        for name, parts in (("one", (16.0,)), ("two", (1.3, 14.7))):
            world = tried.world()
            path = tmp_path / f"{name}.cockpit.jsonl"
            played = GameSession(tried, world, xray, Recorder(path, world, Where(task="straight"), tried.seed))
            xray.frames = 0
            played.handle(Game(type="game", action="start"), 0.0)
            for seconds in parts:
                if played.world.cycle:
                    played = resume_session(path).stage
                    assert played.world.config.robot == played._tried.robot == tried.robot != RobotConfig()
                    assert ready(played.xray).ready and played.phase == "waits" and not played.sight
                    played.handle(Game(type="game", action="start"), 0.0)
                play(played, Drive(type="drive", translation=15.0, rotation=0.5), seconds, until_over=True)
            assert played.phase == "over"
            scores[name] = played.result
            played.close()
    for figure in ("success", "safe", "reason", "seconds", "peak_force_n", "path_ratio"):
        assert scores["two"][figure] == pytest.approx(scores["one"][figure], abs=0.02), figure
    assert resume_session(path).stage.__class__ is Session  # what is over is not played again


@pytest.mark.parametrize("version", [1, 2])
def test_a_navigation_of_the_ladder_is_the_same_to_the_bit(tmp_path, version):
    task = find_task("straight", version=version)
    result = attempt("forward", task.ladder_navigation(0), seed=navigation_seed(task, 0))
    of_version = {} if version == 1 else {"ladder": version}  # as files were before there was a version 2
    write_json(tmp_path / "straight" / "00.json", of_version | result)
    film = shown(open_film(tmp_path / "straight" / "00.json"))
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
    shown(stage.film, start=False)
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
