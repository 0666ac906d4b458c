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
    train(
        toy_dataset,
        output=run,
        config=TrainConfig(network="ff", epochs=1, windows_per_epoch=16, batch_size=16, size=SMALL),
    )
    return read_json(run / "manifest.json")


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory) -> Dataset:
    """Return a dataset of twelve patients, of which six are those of the run's own dataset."""
    folder = tmp_path_factory.mktemp("elsewhere") / "dataset"
    make_toy_dataset(folder, patients=12, sequences=4)
    return read_dataset(folder)


def test_a_run_knows_the_patients_that_it_was_trained_on(own, record):
    trained = set(own.anatomy[own.split == "train"].tolist())
    assert 0 < len(trained) < len(own.patients)
    assert record["patients"] == sorted(own.patients[name] for name in trained)
    assert trained_patients(RUN, record, own) == trained


def test_a_patient_is_known_in_another_dataset_too(own, elsewhere, record):
    known = trained_patients(RUN, record, elsewhere)
    assert known == set(own.anatomy[own.split == "train"].tolist())


def test_simulated_wires_know_nobody_and_take_any_wire(own):
    other = replace(own, manifest=own.manifest | {"device": asdict(read_wire("j-035"))})
    assert trained_patients(RUN, read_run(WIRES), other) == frozenset()


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({"name": "another-name", "friction": 0.2, "max_velocity_mm_s": 1.0}, False),
        ({"diameter_mm": 0.4}, True),
        ({"bend_stiffness_n_mm2": [0.3, 0.3, 1.2, 8.0, 30.0, 81.0]}, True),
        ({"tip_bend_rad": 0.0}, True),
    ],
)
def test_a_dataset_of_another_wire_is_refused(own, record, change, refused):
    other = replace(own, manifest=own.manifest | {"device": own.manifest["device"] | change})
    if not refused:
        assert trained_patients(RUN, record, other)
        return
    with pytest.raises(InputError, match=f"another {next(iter(change))}; make a dataset with the run's wire"):
        trained_patients(RUN, record, other)


def test_a_profile_of_another_length_is_another_wire(own, record):
    device = asdict(read_wire("j-035"))
    with pytest.raises(InputError, match=r"its wire is j-035, and that of a-run is workhorse-014"):
        trained_patients(RUN, record, replace(own, manifest=own.manifest | {"device": device}))
