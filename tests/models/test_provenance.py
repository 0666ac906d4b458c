"""Which patients a run was trained on, and which datasets it may be measured on."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.models.config import WIRES, TrainConfig, TransformerConfig, read_run
from endopilot.models.episodes import trained_patients
from endopilot.models.train import train
from toy_navigation import make_toy_dataset

SMALL = TransformerConfig(d_model=24, heads=2, encoder_layers=1, decoder_layers=1, feedforward=32)
RUN = Path("a-run")


@pytest.fixture(scope="module")
def own(toy_dataset) -> Dataset:
    return read_dataset(toy_dataset)


@pytest.fixture(scope="module")
def record(toy_dataset, tmp_path_factory) -> dict:
    """Return the manifest of a run on the toy patients."""
    run = tmp_path_factory.mktemp("provenance") / "run"
    train(toy_dataset, output=run, config=TrainConfig(network="ff", epochs=1, windows_per_epoch=16, size=SMALL))
    return read_json(run / "manifest.json")


def test_a_run_knows_the_patients_that_it_was_trained_on_in_another_dataset_too(own, record, tmp_path):
    trained = set(own.anatomy[own.split == "train"].tolist())
    assert 0 < len(trained) < len(own.patients)
    assert record["patients"] == sorted(own.patients[name] for name in trained)
    assert trained_patients(RUN, record, own) == trained
    make_toy_dataset(tmp_path / "twelve", patients=12, sequences=4)  # six of them are the run's own
    assert trained_patients(RUN, record, read_dataset(tmp_path / "twelve")) == trained


def test_simulated_wires_know_nobody_and_take_any_wire(own):
    other = replace(own, manifest=own.manifest | {"device": asdict(read_wire("j-035"))})
    assert trained_patients(RUN, read_run(WIRES), other) == frozenset()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "another-name", "friction": 0.2, "max_velocity_mm_s": 1.0}, None),
        ({"diameter_mm": 0.4}, "another diameter_mm; make a dataset with the run's wire"),
        ({"tip_bend_rad": 0.0}, "another tip_bend_rad; make a dataset with the run's wire"),
        (asdict(read_wire("j-035")), "its wire is j-035, and that of a-run is workhorse-014"),
    ],
)
def test_a_dataset_of_another_wire_is_refused(own, record, change, message):
    other = replace(own, manifest=own.manifest | {"device": own.manifest["device"] | change})
    if message is None:
        assert trained_patients(RUN, record, other)
        return
    with pytest.raises(InputError, match=message):
        trained_patients(RUN, record, other)
