"""Wires, catheters and robots, and their files."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import endopilot
from command import run
from endopilot.devices.catheter import list_catheters, read_catheter, write_device
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.device_files import device_yaml, list_wires, user_devices
from endopilot.devices.robot import DriveConfig, RobotConfig, list_robots, read_robot
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError

SHIPPED = Path(endopilot.__file__).parent / "devices/wires"


@pytest.mark.parametrize("name", list_wires())
def test_shipped_devices_are_whole(name: str) -> None:
    device = read_wire(name)
    assert device.name == name
    assert all(len(source) > 10 for source in device.sources.values())
    assert Wire(**asdict(device)) == device
    summary = device.summary()
    for name, profile in (("ei", device.bend_stiffness), ("gj", device.twist_stiffness)):
        ends = [summary[f"{name}_{end}_n_mm2"] for end in ("tip", "shaft")]
        assert ends == profile(np.array([0.0, 1e3])).tolist()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("value: 0.36", "value: -0.36", "diameter_mm.value: -0.36; give a number from 0.15 to 10 mm"),
        ("friction:", "frixion:", "frixion: no such field; did you mean friction?"),
        ("  value: 0.1\n", "", "friction.value: missing; add it"),
        ('source: "0.05 hydrophilic to 0.2 bare"', 'source: " "', "friction.source: ' '; give some text"),
        ("\n  value: 0.36\n", " 0.36\n# ", "diameter_mm: 0.36; write it as {value: ..., source: ...}"),
        ("length_mm: 3", "length_mm: 0", "tip_bend: length_mm is 0; give a bent tip a positive length"),
        ("[0.30, 0.30, 1.2", "[0.30, 1.2", "bend_stiffness_n_mm2: 5 values, but abscissa_mm has 6; give one for each"),
        ("[0, 10, 20, 60", "[0, 20, 10, 60", "abscissa_mm: [0.0, 20.0, 10.0, 60.0, 150.0, 300.0]; begin at 0, the tip"),
    ],
)
def test_bad_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (SHIPPED / "workhorse-014.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "wire.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as error:
        read_wire(path)
    assert str(error.value).startswith(f"{path}: {message}")
    assert "\n" not in str(error.value)


def test_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="workhorse-014"):
        read_wire("no-such-wire")
    with pytest.raises(InputError, match="tip_load_n"):
        replace(read_wire("workhorse-014"), tip_load_n=-1.0)


def test_another_tip_leaves_the_shaft_as_it_is() -> None:
    device = read_wire("workhorse-014")
    other = device.with_tip(bend_rad=1.0, stiffness_factor=2.0)
    at = np.array([0.0, 10.0, 15.0, 20.0, 60.0, 400.0])
    assert other.tip_bend_rad == 1.0
    np.testing.assert_allclose(other.bend_stiffness(at)[:2], 2 * device.bend_stiffness(at)[:2])
    np.testing.assert_allclose(other.twist_stiffness(at)[:2], 2 * device.twist_stiffness(at)[:2])
    assert device.bend_stiffness(at)[2] < other.bend_stiffness(at)[2] < 2 * device.bend_stiffness(at)[2]
    np.testing.assert_array_equal(other.bend_stiffness(at)[3:], device.bend_stiffness(at)[3:])
    assert device.with_tip(bend_rad=device.tip_bend_rad, stiffness_factor=1.0) == device


@pytest.mark.parametrize("name", list_wires())
def test_a_written_device_is_read_with_the_same_constants(tmp_path: Path, name: str) -> None:
    device = read_wire(name)
    changed = device.with_tip(bend_rad=1.234567 * device.tip_bend_rad, stiffness_factor=1.1)
    for each in (device, device.shaped(75.0, 5.0), replace(changed, friction=0.123)):
        write_device(each, output=tmp_path / "wire.yaml")
        back = read_wire(tmp_path / "wire.yaml")
        assert back.constants == each.constants and back.tip_shaping == each.tip_shaping
        assert back.sources == each.sources


def test_a_stack_is_made_of_names() -> None:
    named, around = Stack.of("workhorse-014", "microcatheter-1.7f"), read_catheter("microcatheter-1.7f")
    assert named == Stack(read_wire("workhorse-014"), (around,)) == Stack.of(Stack.of("workhorse-014"), around)
    assert Stack.of(named) == named


@pytest.fixture
def folders(tmp_path, monkeypatch) -> tuple[Path, Path]:
    """Return the folder of the user's configuration and that of the environment variable, a thick wire in each."""
    own, named = tmp_path / "config" / "endopilot" / "devices", tmp_path / "lab"
    for folder in (own, named):
        folder.mkdir(parents=True)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("ENDOPILOT_DEVICES", str(named))
    for folder, name in ((own, "mine"), (named, "ours")):
        text = device_yaml("workhorse-014")[1].replace("name: workhorse-014", f"name: {name}")
        (folder / f"{name}.yaml").write_text(text.replace("value: 0.36", "value: 0.5"), encoding="utf-8")
    return own, named


def test_devices_in_both_folders_are_read_by_their_names(folders):
    for name in ("mine", "ours"):
        assert read_wire(name).diameter_mm == 0.5
    assert "mine" not in list_wires()  # tasks and benchmarks use shipped devices alone
    with pytest.raises(InputError, match=r"device 'theirs': no such device or file; .*workhorse-014, mine, ours"):
        read_wire("theirs")


def test_without_a_variable_the_folder_is_in_the_user_s_home(folders, tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.delenv("ENDOPILOT_DEVICES")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_devices() == ()
    (tmp_path / "config").rename(tmp_path / ".config")
    assert user_devices() == ("mine",)


@pytest.mark.parametrize("name", ["ours", "workhorse-014"])
def test_a_name_that_two_files_bear_is_refused(folders, name):
    (folders[0] / f"{name}.yaml").write_text(device_yaml(name)[1], encoding="utf-8")
    with pytest.raises(
        InputError, match=f"device '{name}': .*{name}.yaml and .*{name}.yaml both hold it; rename yours"
    ):
        read_wire(name)
    assert read_wire(folders[0] / f"{name}.yaml").name == name  # by its path it can be read
    assert read_wire("mine").name == "mine"  # other names are not concerned


def test_a_variable_that_names_no_folder_is_refused(folders, monkeypatch):
    monkeypatch.setenv("ENDOPILOT_DEVICES", "/nowhere/devices")
    with pytest.raises(InputError, match="ENDOPILOT_DEVICES=/nowhere/devices: no such folder"):
        read_wire("workhorse-014")


def test_the_command_lists_devices_with_their_origin(folders, capsys):
    rows = {row["name"]: row for row in run(capsys, "devices")}
    assert list(rows) == [*list_wires(), "mine", "ours", *list_catheters()]
    assert rows["j-035"]["origin"] == "endopilot" and rows["ours"]["origin"] == str(folders[1] / "ours.yaml")
    assert [rows["vertebral-5f"] | {"inner_diameter_mm": 1.2}] == run(capsys, "devices", "vertebral-5f")


def test_a_robot_is_written_and_read_back_and_what_a_file_leaves_out_is_assumed(tmp_path) -> None:
    robot = RobotConfig(
        encoders_at="motor",
        jitter_s=0.01,
        wire=DriveConfig(gain_translation=1.03, play_mm=2.4, grip_n=0.3, transmission=Transmission(length_mm=900.0)),
        catheters=(DriveConfig(play_rad=0.2), DriveConfig(grip_n_mm=0.1)),
        sources=("play_mm: measured — 2,4 mm",),
    )
    robot.write(tmp_path / "robot.yaml")
    assert read_robot(tmp_path / "robot.yaml") == robot
    path = tmp_path / "part.yaml"
    path.write_text("encoders_at: motor\nwire: {play_mm: 2.4}\n", encoding="utf-8")
    assert read_robot(str(path)) == RobotConfig(encoders_at="motor", wire=DriveConfig(play_mm=2.4))


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
        ("wire: {play_rad: 324}", r"wire.play_rad: 324; give a number from 0 to 50 rad \(324 ° is 5\.655 rad\)"),
        ("catheters: []", r"catheters: \[\]; give at least one drive"),
        ("catheters: [{grip_n: 0}]", r"catheters\[0\].grip_n: 0; give a positive number"),
    ],
)
def test_a_fault_is_told_in_one_line(tmp_path, text, message) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=f"robot.yaml: {message}"):
        read_robot(path)


def test_a_grip_weakens_a_device_and_never_strengthens_it() -> None:
    wire = read_wire("workhorse-014")
    assert DriveConfig().gripped(wire) == wire == DriveConfig(grip_n=9.0, grip_n_mm=9.0).gripped(wire)
    held = DriveConfig(grip_n=0.2, grip_n_mm=0.1).gripped(wire)
    assert (held.push_limit_n, held.pull_limit_n, held.torque_limit_n_mm) == (0.2, 0.2, 0.1)
