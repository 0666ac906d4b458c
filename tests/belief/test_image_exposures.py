"""Images of a dataset's navigations: what the C-arm is asked, what is held where it finds no wire, what is kept."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from endopilot import parallel
from endopilot.belief import image_exposures as module
from endopilot.belief.image_exposures import ImageSettings, deeper_ostium_mm, image_exposures
from endopilot.dataset.loader import read_dataset
from endopilot.errors import InputError
from endopilot.simulation.motion import Motion
from endopilot.xray.fluoroscope import FluoroscopeConfig, TipMeasurement
from endopilot.xray.image_fluoroscope import NotRegistered
from endopilot.xray.moving_patient import seen_in_episodes
from toy_navigation import make_toy_dataset, toy_run

SETTINGS = ImageSettings(FluoroscopeConfig(), ostium_mm=0.3, seed=2, samples=4)


class Arm:
    """Measures the foremost node as it is; finds no wire in the third image of a navigation."""

    made: ClassVar[list[str]] = []
    refined: ClassVar[list[bool]] = []

    def __init__(self, anatomy, device, config, seed) -> None:
        self.made.append(anatomy.name)
        if anatomy.name.endswith("-1x"):
            raise NotRegistered(f"X-ray images: {anatomy.name} cannot be registered: nothing seen")

    def measure_motion(self, motion, random) -> Motion:
        return replace(motion, breathing_caudal_mm=motion.breathing_caudal_mm - 1.5)

    def forget_wires(self) -> None:
        self._images = 0

    def measure(self, nodes, inserted_length, random, *, refine) -> TipMeasurement | None:
        self._images += 1
        self.refined.append(refine)
        tip = nodes[0]
        return None if self._images == 3 else TipMeasurement(tip, float(tip[0]), float(tip[1]), 0, tip_sd_mm=(0.2, 0.1))


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    make_toy_dataset(
        tmp_path / "data", patients=3, sequences=2, seconds=20.0, anatomy_shares=(0, 0, 1), seen_test_share=0.0
    )
    monkeypatch.setattr(module, "ImageFluoroscope", Arm)
    monkeypatch.setattr(parallel, "CORES", 1)
    monkeypatch.setattr("endopilot.dataset.loader.run_set_up", toy_run)
    Arm.made.clear()
    Arm.refined.clear()
    return read_dataset(tmp_path / "data").of_split("test")


def test_each_sample_is_measured_by_the_wire_driven_again_and_kept_for_the_next_model(dataset) -> None:
    found, left_out = image_exposures(dataset, SETTINGS)
    assert left_out == ("patient-1x",) and sorted(found) == ["patient-0", "patient-2xx"]
    for name, shown in found.items():
        truth = dataset[dataset.anatomy == name]
        assert shown.found.shape == truth.valid.shape
        assert shown.found[:, :5].tolist() == [[True, True, False, True, False]] * 2
        seen = [0, 1, 3]
        np.testing.assert_allclose(shown.tip[:, seen, 0], truth.tip_abscissa[:, seen, 0], atol=1e-4)
        np.testing.assert_allclose(shown.tip[:, seen, 1], truth.tip_offset[:, seen, 0], atol=1e-4)
        assert (shown.sd_mm[:, seen] == (0.2, 0.1)).all() and (shown.sd_mm[:, 2] == 0).all()
        slack = truth.inserted_length[..., 0] - deeper_ostium_mm(name, 0.3, 2) - shown.tip[..., 0]
        np.testing.assert_allclose(slack[:, 2], slack[:, 1], atol=1e-4)
        np.testing.assert_allclose(slack[:, 4:], slack[:, 3:4] + np.zeros((1, 36)), atol=1e-4)
    assert all(Arm.refined)  # the first 15 s refine the pose
    made = len(Arm.made)
    again, _ = image_exposures(dataset, SETTINGS)
    assert Arm.made[made:] == ["patient-1x"]  # the others are read
    np.testing.assert_array_equal(again["patient-0"].tip, found["patient-0"].tip)
    image_exposures(dataset, replace(SETTINGS, samples=32))
    assert Arm.refined.count(False) == 2 * 2 * 2  # two patients, two navigations, the 31st and 32nd sample


def test_where_the_patient_moves_the_wire_is_seen_displaced_by_what_was_not_measured(dataset, monkeypatch) -> None:
    still, _ = image_exposures(dataset, SETTINGS)
    motion = replace(Motion(), breathing_caudal_mm=8.0)
    monkeypatch.setattr("endopilot.dataset.loader.Dataset.motion", lambda self, name: motion)
    moving, _ = image_exposures(dataset, replace(SETTINGS, seed=3))
    known = moving["patient-0"].known_motion
    assert still["patient-0"].known_motion is None and known == replace(motion, breathing_caudal_mm=6.5)
    maps = seen_in_episodes(motion, known, np.zeros(3), 4, 0.5)
    assert maps is not None
    before = dataset[dataset.anatomy == "patient-0"].tip_position[:, 3, 0].astype(float)
    after = before @ maps[3, :, :3].T + maps[3, :, 3]
    np.testing.assert_allclose(moving["patient-0"].tip[:, 3, 0], after[:, 0], atol=1e-4)
    assert np.abs(moving["patient-0"].tip[:, 3] - still["patient-0"].tip[:, 3]).max() > 1e-3


def test_a_split_of_which_nobody_can_be_registered_is_told(dataset) -> None:
    with pytest.raises(InputError, match="no patient of its split 'test' can be registered; the first: X-ray images"):
        image_exposures(dataset[dataset.anatomy == "patient-1x"], SETTINGS)
