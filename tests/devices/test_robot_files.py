"""Robots as files: what is written is read back, presets are there, and faults are told in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.device import read_wire
from endopilot.devices.robot import DriveConfig, RobotConfig, list_robots, read_robot
from endopilot.devices.stack import Transmission
from endopilot.errors import InputError


def test_a_robot_is_written_and_read_back(tmp_path) -> None:
    robot = RobotConfig(
        encoders_at="motor",
        jitter_s=0.01,
        wire=DriveConfig(gain_translation=1.03, play_mm=2.4, grip_n=0.3, transmission=Transmission(length_mm=900.0)),
        catheters=(DriveConfig(play_rad=0.2), DriveConfig(grip_n_mm=0.1)),
        sources=("play_mm: measured — 2,4 mm",),
    )
    robot.write(tmp_path / "robot.yaml")
    assert read_robot(tmp_path / "robot.yaml") == robot
    assert read_robot(str(tmp_path / "robot.yaml")) == robot


def test_what_a_file_leaves_out_is_assumed(tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("encoders_at: motor\nwire: {play_mm: 2.4}\n", encoding="utf-8")
    expected = replace(RobotConfig(), encoders_at="motor", wire=replace(DriveConfig(), play_mm=2.4))
    assert read_robot(path) == expected


def test_the_robots_of_the_package() -> None:
    robots = {name: read_robot(name) for name in list_robots()}
    assert next(iter(robots)) == "assumed" and robots["assumed"] == RobotConfig()
    ideal = robots.pop("ideal")
    assert (ideal.latency_s, ideal.jitter_s, ideal.wire.play_mm, ideal.wire.play_rad) == (0, 0, 0, 0)
    assert not ideal.of_drives(1, "encoder_sd_mm", "encoder_sd_rad", "load_sd_n", "load_sd_n_mm").any()
    assert ideal.catheters == (ideal.wire,)
    measured = {name: robot for name, robot in robots.items() if name != "assumed"}
    assert all(robot.sources and robot.encoders_at == "motor" for robot in measured.values())
    flat, deep = measured["kweon-2021-2d"].wire, measured["kweon-2021-3d"].wire
    assert (flat.play_mm, deep.play_mm) == (2.6, 1.1)
    assert all(wire.transmission.length_mm and not wire.play_rad for wire in (flat, deep))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("latency_s: 50", r"latency_s: 50; give a number from 0 to 10 s \(50 ms is 0\.05 s\)"),
        ("encoders_at: gears", "encoders_at: 'gears'; choose from 'motor' or 'wire'"),
        ("wire: {play_mm: -1}", "wire.play_mm: -1; give a number from 0 to 50 mm"),
        ("wire: {play_rad: 324}", r"wire.play_rad: 324; give a number from 0 to 50 rad \(324 ° is 5\.655 rad\)"),
        ("wire: {gain_translation: 101}", "wire.gain_translation: 101; give a number from 0.5 to 2"),
        (
            "wire: {transmission: {length_mm: 9000}}",
            r"wire.transmission.length_mm: 9000; give a number from 0 to 3000 mm",
        ),
        ("wire: {backlash_mm: 1}", "wire.backlash_mm: no such field"),
        ("catheters: []", r"catheters: \[\]; give at least one drive"),
        ("catheters: [{grip_n: 0}]", r"catheters\[0\].grip_n: 0; give a positive number"),
    ],
)
def test_a_fault_is_told_in_one_line(tmp_path, text, message) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=f"robot.yaml: {message}"):
        read_robot(path)


def test_a_name_that_is_none_is_refused_with_those_there_are() -> None:
    with pytest.raises(InputError, match="robot 'corpath': no such robot or file; give a path, or choose from assumed"):
        read_robot("corpath")


def test_a_grip_weakens_a_device_and_never_strengthens_it() -> None:
    wire = read_wire("workhorse-014")
    assert DriveConfig().gripped(wire) is wire and DriveConfig(grip_n=9.0, grip_n_mm=9.0).gripped(wire) is wire
    held = DriveConfig(grip_n=0.2, grip_n_mm=0.1).gripped(wire)
    assert (held.push_limit_n, held.pull_limit_n, held.torque_limit_n_mm) == (0.2, 0.2, 0.1)
    assert np.isclose(RobotConfig(latency_s=0.05).delayed(1.2).latency_s, 0.06)
