"""Datasets read as one: whose episodes, whose split, and what is refused."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from endopilot.dataset.loader import read_dataset, read_joined
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.simulation.motion import Motion
from toy_navigation import make_toy_dataset


@pytest.fixture(scope="module")
def second(tmp_path_factory) -> Path:
    """Return a dataset in the patients of `toy_dataset`, which trains on all of them."""
    folder = tmp_path_factory.mktemp("second") / "dataset"
    make_toy_dataset(folder, patients=6, sequences=4, anatomy_shares=(1.0, 0.0, 0.0))
    return folder


def test_episodes_stand_behind_each_other(toy_dataset, second):
    parts, both = [read_dataset(folder) for folder in (toy_dataset, second)], read_joined([toy_dataset, second])
    assert len(both) == sum(map(len, parts))
    for name in ("tip_abscissa", "control", "valid", "friction", "anatomy"):
        np.testing.assert_array_equal(getattr(both, name), np.concatenate([getattr(part, name) for part in parts]))
    assert both.manifest["key"] not in {part.manifest["key"] for part in parts}
    for name in np.unique(both.anatomy).tolist():
        assert both.anatomy_folder(name).exists()


def test_a_patient_that_is_kept_for_a_test_trains_in_no_dataset(toy_dataset, second):
    first, both = read_dataset(toy_dataset), read_joined([toy_dataset, second])
    kept = {str(name) for name in first.anatomy[np.isin(first.split, ("calibrate", "test"))]}
    later = read_dataset(second)
    at_odds = [name for name in kept if ((later.anatomy == name) & (later.split == "train")).any()]
    assert at_odds, "the second dataset trains on a patient that the first one keeps"
    assert not kept & {str(name) for name in both.anatomy[both.split == "train"]}


def test_what_does_not_go_together_is_refused(toy_dataset, second):
    with pytest.raises(InputError, match="dataset: none given"):
        read_joined([])
    other = read_dataset(second)
    device = other.manifest["device"]
    cases = {
        "another tip_bend_rad; join datasets of one wire": {"device": device | {"tip_bend_rad": 1.0}},
        "is another than that of .*; rename one": {
            "anatomies": [record | {"sha256": "0"} for record in other.manifest["anatomies"]]
        },
        "moves otherwise than in .*; join datasets of other patients": {
            "anatomies": [record | {"motion": asdict(Motion())} for record in other.manifest["anatomies"]]
        },
    }
    changed = second.with_name("changed")
    shutil.copytree(second, changed)
    for message, change in cases.items():
        write_json(changed / "meta" / "manifest.json", other.manifest | change)
        with pytest.raises(InputError, match=message):
            read_joined([toy_dataset, changed])
    write_json(
        changed / "meta" / "manifest.json", other.manifest | {"device": device | {"friction": 0.3, "name": "me"}}
    )
    assert len(read_joined([toy_dataset, changed])) > len(other)
