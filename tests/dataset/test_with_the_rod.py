"""The dataset made with the real rod core."""

from __future__ import annotations

import numpy as np

from endopilot.anatomy.atlas import AtlasConfig, synthesize_one
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.dataset.generate import DatasetConfig, generate_dataset
from endopilot.dataset.loader import load_dataset
from endopilot.simulation.device import read_device
from endopilot.simulation.simulator import simulate


def test_an_episode_simulated_from_the_disk_repeats_to_the_bit(tmp_path):
    write_anatomy(synthesize_one(AtlasConfig(count=1, seed=4), 0), tmp_path / "patient")
    device = read_device("workhorse-014")
    config = DatasetConfig(sequences=4, seconds=4.0, friction=(0.05, 0.2), seed=2)
    generate_dataset([tmp_path / "patient"], tmp_path / "dataset", device, config)
    data = load_dataset(tmp_path / "dataset")
    assert data.valid.all()
    assert set(data.device) == {device.name}
    assert (data.anatomy_folder(str(data.anatomy[0]))) == (tmp_path / "patient").resolve()
    again = simulate(
        read_anatomy(data.anatomy_folder(str(data.anatomy[0]))),
        device,
        data.control.astype(float),
        initial=np.stack([data.initial_inserted_length, data.initial_rotation], axis=-1),
        config=config.simulator,
        friction=data.friction,
    )
    np.testing.assert_array_equal(again.tip.abscissa.astype(np.float32), data.tip_abscissa)
    np.testing.assert_array_equal(again.contact_force_sum.astype(np.float32), data.contact_force_sum)
    assert np.ptp(data.tip_abscissa, axis=1).max() > 1
