"""Devices in folders of the user's: found by name, and refused where a name is not unique."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from endopilot.cli import main
from endopilot.devices.device import read_wire
from endopilot.devices.device_files import device_yaml, list_wires, user_devices
from endopilot.errors import InputError


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
    assert user_devices() == ("mine", "ours")
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


def test_the_same_folder_named_twice_is_one(folders, monkeypatch):
    monkeypatch.setenv("ENDOPILOT_DEVICES", str(folders[0] / ".." / "devices"))
    assert user_devices() == ("mine",) and read_wire("mine").diameter_mm == 0.5


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
    with pytest.raises(SystemExit) as leaving:
        main(["devices", "--json"])
    assert leaving.value.code == 0
    rows = {row["name"]: row["origin"] for row in json.loads(capsys.readouterr().out)}
    assert list(rows) == [*list_wires(), "mine", "ours"]
    assert rows["j-035"] == "endopilot" and rows["ours"] == str(folders[1] / "ours.yaml")
