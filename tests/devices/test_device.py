from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import endopilot
from endopilot.devices.catheter import read_catheter, write_device
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.device_files import list_wires
from endopilot.devices.stack import Stack
from endopilot.errors import InputError

SHIPPED = Path(endopilot.__file__).parent / "devices/wires"


@pytest.mark.parametrize("name", list_wires())
def test_shipped_devices_are_whole(name: str) -> None:
    device = read_wire(name)
    assert device.name == name
    assert all(len(source) > 10 for source in device.sources.values())
    assert Wire(**asdict(device)) == device
    summary = device.summary()
    assert summary["ei_tip_n_mm2"] == device.bend_stiffness(np.array([0.0]))[0]
    assert summary["ei_shaft_n_mm2"] == device.bend_stiffness(np.array([1e3]))[0]
    assert summary["gj_tip_n_mm2"] == device.twist_stiffness(np.array([0.0]))[0]
    assert summary["gj_shaft_n_mm2"] == device.twist_stiffness(np.array([1e3]))[0]
    if device.tip_load_n is not None:
        assert summary["tip_load_gf"] == pytest.approx(device.tip_load_n / 9.80665e-3, abs=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("value: 0.36", "value: -0.36", "diameter_mm.value: -0.36; give a number from 0.15 to 10 mm"),
        ("friction:", "frixion:", "frixion: no such field; did you mean friction?"),
        ("  value: 0.1\n", "", "friction.value: missing; add it"),
        ('source: "0.05 hydrophilic to 0.2 bare"', 'source: " "', "friction.source: ' '; give some text"),
        ('source: "0.05', 'sources: "0.05', "friction.sources: no such field; did you mean source?"),
        ("\n  value: 0.36\n", " 0.36\n# ", "diameter_mm: 0.36; write it as {value: ..., source: ...}"),
        ("length_mm: 3", "length_mm: 0", "tip_bend: length_mm is 0; give a bent tip a positive length"),
        ("length_mm: 3", "length_cm: 3", "tip_bend.length_cm: no such field; did you mean length_mm?"),
        ("angle_deg: 45", "angle_deg: 450", "tip_bend.angle_deg: 450; give a number from -360 to 360"),
        ("[0.30, 0.30, 1.2", "[0.30, 1.2", "bend_stiffness_n_mm2: 5 values, but abscissa_mm has 6; give one for each"),
        (
            "[0.30, 0.30, 1.2",
            "[0.30, -0.30, 1.2",
            "bend_stiffness_n_mm2.value[1]: -0.3; give a number from 0.0001 to 1000000 N·mm²",
        ),
        ("[0.23, 0.23, 0.92, 6.2, 23, 62]", "5", "twist_stiffness_n_mm2.value: 5; give a list of values"),
        ("name: workhorse-014", "name: 14", "name: 14; give text"),
        ("name: workhorse-014", "name: [", "line 4: not valid YAML"),
        ("[0, 10, 20, 60", "[0, 20, 10, 60", "abscissa_mm: [0.0, 20.0, 10.0, 60.0, 150.0, 300.0]; begin at 0, the tip"),
        ("name: work", "extra: 1\nname: work", "extra: no such field; the fields are name, diameter_mm, friction"),
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


def test_a_file_that_is_no_device_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wire.yaml"
    path.write_text("- 1\n")
    with pytest.raises(InputError, match="no mapping of fields"):
        read_wire(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no text"):
        read_wire(path)
    with pytest.raises(InputError, match="no such device or file"):
        read_wire(tmp_path)


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
