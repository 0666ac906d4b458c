"""A task driven by hand: what is hidden, when it ends, and that its score is that of the ladder's own code."""

from __future__ import annotations

import time
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from endopilot.cockpit import game
from endopilot.cockpit.frames import decode
from endopilot.cockpit.game import Attempt, GameSession
from endopilot.cockpit.messages import Autopilot, Drive, Game, Pedal, Target
from endopilot.cockpit.open import resume_session
from endopilot.cockpit.recording import Recorder, Where
from endopilot.cockpit.session import Session
from endopilot.cockpit.world import LiveWorld
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.errors import InputError
from endopilot.tasks.task import find_task

HIDDEN = {"tip_mm", "offset_mm", "section", "force_n", "wall_force_n", "peak_force_n"}


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
def played(navigation, xray):
    world = LiveWorld(replace(navigation, seconds=6.0, force_limit_n=0.3))
    with patch.object(game, "Workers", Rival):
        made = GameSession(Attempt(find_task("straight"), 0), world, xray)
        yield made
        made.close()


def play(session, message, seconds):
    last = {}
    for number in range(round(seconds / session.world.config.cycle_s)):
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
                    until = time.monotonic() + 20
                    while not played.xray.ready and time.monotonic() < until:
                        time.sleep(0.01)
                    assert played.phase == "waits" and not played.sight
                    played.handle(Game(type="game", action="start"), 0.0)
                play(played, Drive(type="drive", translation=15.0, rotation=0.5), seconds)
            assert played.phase == "over"
            scores[name] = played.result
            played.close()
    for figure in ("success", "safe", "reason", "seconds", "peak_force_n", "path_ratio"):
        assert scores["two"][figure] == pytest.approx(scores["one"][figure], abs=0.02), figure
    assert resume_session(path).stage.__class__ is Session  # what is over is not played again
