from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from endopilot.errors import InputError
from endopilot.simulation.device import Device, list_devices, read_device

SHIPPED = Path(__file__).parents[2] / "src/endopilot/simulation/devices"


@pytest.mark.parametrize("name", list_devices())
def test_shipped_devices_are_whole(name: str) -> None:
    device = read_device(name)
    assert device.name == name
    assert all(len(source) > 10 for source in device.sources.values())
    assert Device(**asdict(device)) == device
    assert device.summary()["diameter_mm"] == device.diameter_mm


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("value: 0.36", "value: -0.36", "diameter_mm = -0.36"),
        ("value: 0.36", "value: thick", "diameter_mm = 'thick'"),
        ("friction:", "frixion:", "friction is missing"),
        ('source: "0.05', 'note: "0.05', "friction has no source"),
        ("[0, 10, 20, 60", "[0, 20, 10, 60", "abscissa_mm"),
        ("[0.30, 0.30, 1.2", "[0.30, 0.0, 1.2", "bend_stiffness_n_mm2"),
        ("name: work", "extra: 1\nname: work", "extra is unknown"),
    ],
)
def test_bad_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = (SHIPPED / "workhorse-014.yaml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "wire.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_device(path)
    assert str(path) in str(error.value)


def test_unknown_device_is_refused() -> None:
    with pytest.raises(InputError, match="workhorse-014"):
        read_device("no-such-wire")
    with pytest.raises(InputError, match="tip_load_n"):
        replace(read_device("workhorse-014"), tip_load_n=-1.0)
