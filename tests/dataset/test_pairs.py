"""Datasets of wires in catheters: what is stored, what repeats it, what holds it back, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.anatomy.projection import project_tip
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.cli import main
from endopilot.dataset import join
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.draw import draw_navigations
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.info import describe_dataset
from endopilot.dataset.join import load_joined
from endopilot.dataset.loader import load_dataset
from endopilot.dataset.navigations import STOP_SHORT_MM, simulate_navigations
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_device
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.models.episodes import Episodes
from endopilot.models.provenance import check_wire
from endopilot.simulation.simulate import simulate

WIRE, CATHETER = read_device("workhorse-014"), read_catheter("microcatheter-1.7f")
CONFIG = DatasetConfig(sequences=3, seconds=10.0, seed=7)


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    folder = tmp_path_factory.mktemp("anatomies") / "patient"
    write_anatomy(make_patient(AtlasConfig(count=1, seed=4, population="textbook"), 0), folder)
    return folder


@pytest.fixture(scope="module")
def pairs(patient, tmp_path_factory):
    """Return a dataset of a wire in a weakly driven catheter, which slips."""
    weak = replace(CATHETER, device=replace(CATHETER.device, push_limit_n=0.03, pull_limit_n=0.021))
    folder = tmp_path_factory.mktemp("pairs") / "dataset"
    generate_dataset([patient], folder, WIRE, CONFIG, catheters=[weak])
    return folder


def test_the_commands_of_both_devices_repeat_an_episode_to_the_bit(pairs, patient):
    data = load_dataset(pairs)
    assert data.valid.all() and data.command.shape == (3, 20, 4)
    assert (data.catheter_slip != 0).any()
    vessel = read_anatomy(patient)
    again = simulate(
        vessel,
        WIRE,
        data.command,
        catheters=data.catheters,
        initial=data.initial,
        config=CONFIG.simulator,
        friction=data.friction,
    )
    motion = again.catheters
    assert motion is not None
    np.testing.assert_array_equal(again.tip_position.astype(np.float32), data.tip_position)
    tip = project_tip(vessel.tree, vessel.insertion, motion.tip_position)
    same = {
        "control": motion.control,
        "inserted_length": motion.inserted_length,
        "rotation": motion.rotation,
        "tip_abscissa": tip.abscissa,
        "tip_offset": tip.offset,
        "tip_position": motion.tip_position,
        "branch": tip.branch,
        "base_force": motion.base_force,
        "base_torque": motion.base_torque,
        "drive_force": motion.drive_force,
        "drive_torque": motion.drive_torque,
    }
    for name, values in same.items():
        stored = getattr(data, f"catheter_{name}")
        np.testing.assert_array_equal(values.astype(stored.dtype), stored, err_msg=name)
    first = data.catheter_inserted_length[:, 0, 0] - 0.5 * data.catheter_control[:, 0, 0, 0]
    assert np.abs(first - data.initial[:, 2]).max() > 0.01  # one is carried along before the first period
    np.testing.assert_allclose(motion.slip, data.catheter_slip, atol=1e-6)
    np.testing.assert_allclose(motion.rotation_slip, data.catheter_rotation_slip, atol=1e-6)
    slips_mm_s = np.abs(data.catheter_slip[..., 0]) / 0.5
    assert (slips_mm_s > 1.1 * np.abs(data.command[..., 2])).any()  # is carried along by the wire


def test_devices_and_columns_are_named(pairs):
    data, info = load_dataset(pairs), read_json(pairs / "meta/info.json")
    assert [catheter.name for catheter in data.catheters] == ["microcatheter-1.7f"]
    assert data.catheters[0].device.push_limit_n == 0.03
    assert describe_dataset(pairs).figures["catheters"] == ["microcatheter-1.7f"]
    drives = ["translation_mm_s", "rotation_rad_s"]
    assert info["features"]["action"]["names"] == drives + [f"catheter_1_{name}" for name in drives]
    assert info["features"]["observation.state"]["shape"] == [8]
    stats = read_json(pairs / "meta/stats.json")
    np.testing.assert_allclose(stats["action"]["mean"][2:], data.catheter_control.mean(axis=(0, 1, 2)), atol=1e-6)


def test_the_wire_is_driven_as_it_is_without_a_catheter(patient):
    vessel = read_anatomy(patient)
    alone = draw_navigations(CONFIG, WIRE, vessel, range(3))
    both = draw_navigations(CONFIG, WIRE, vessel, range(3), catheters=1)
    later = draw_navigations(CONFIG, WIRE, vessel, range(2, 3), catheters=1)
    np.testing.assert_array_equal(both.control[..., :2], alone.control)
    np.testing.assert_array_equal(both.initial[:, :2], alone.initial)
    np.testing.assert_array_equal(both.control[2:], later.control)
    assert np.abs(both.control[..., 2:] - alone.control).max() > 1  # independently


def test_a_catheter_stops_short_of_the_end_of_the_vessel(patient):
    vessel = read_anatomy(patient)
    leaves = vessel.tree.leaves()
    ends = np.array([b.centerline.abscissa[-1] if i in leaves else np.inf for i, b in enumerate(vessel.tree.branches)])
    initial = np.array([[5.0, 0.0, 90.0, 0.0], [5.0, 0.0, 1.5 * ends[np.isfinite(ends)].max(), 1.0]])
    control = np.tile([0.0, 0.0, 12.0, 0.5], (2, 16, 1))
    rollout, started, applied, stopped = simulate_navigations(
        vessel, [WIRE] * 2, initial, control, np.full(2, 0.1), CONFIG.simulator, catheters=[CATHETER]
    )
    assert rollout.valid.all() and rollout.catheters is not None
    assert stopped.all()
    assert started[1, 2] < initial[1, 2]
    tip = project_tip(vessel.tree, vessel.insertion, rollout.catheters.tip_position[:, :, 0])
    assert (tip.abscissa < ends[tip.branch] - 0.5 * STOP_SHORT_MM).all()
    assert tip.abscissa.max() > 60
    assert applied[..., 2].min() < 0  # pushed into a dead end, it is pulled back
    np.testing.assert_array_equal(applied[..., 0], 0.0)


def test_models_refuse_it_with_one_line(pairs, capsys, tmp_path):
    data = load_dataset(pairs)
    line = "its wires lie in microcatheter-1.7f, and a model takes a wire alone; make a dataset without --catheter"
    for refused in (lambda: Episodes.of_dataset(data), lambda: check_wire(pairs, {"device": {}}, data)):
        with pytest.raises(InputError, match=line):
            refused()
    with pytest.raises(SystemExit) as leaving:
        main(["train", str(pairs), "-o", str(tmp_path / "run")])
    assert leaving.value.code == 2
    assert line in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


def test_what_does_not_go_together_is_refused(pairs, patient, tmp_path, monkeypatch):
    data = load_dataset(pairs)
    bare = replace(data, folder=tmp_path, manifest={k: v for k, v in data.manifest.items() if k != "catheters"})
    monkeypatch.setattr(join, "load_dataset", {pairs: data, tmp_path: bare}.__getitem__)
    with pytest.raises(InputError, match=r"lies in no catheter, and that of .* in microcatheter-1\.7f; join"):
        load_joined([pairs, tmp_path])
    assert len(load_joined([pairs, pairs]).catheter_slip) == 2 * len(data)
    with pytest.raises(InputError, match="control: 'force' with catheters; give 'velocity'"):
        generate_dataset([patient], tmp_path / "f", WIRE, replace(CONFIG, control="force"), catheters=[CATHETER])
    with pytest.raises(InputError, match="too wide for the bore"):
        generate_dataset([patient], tmp_path / "w", read_device("j-035"), CONFIG, catheters=[CATHETER])
    assert not (tmp_path / "f").exists() and not (tmp_path / "w").exists()
