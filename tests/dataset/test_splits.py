"""The split: by count, by hash, and without a leak."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from endopilot.dataset.layout import assign_splits
from endopilot.errors import InputError

NAMES = [f"patient-{i:03d}" for i in range(100)]


def test_shares_become_counts():
    splits = assign_splits(NAMES, 10)
    by_anatomy = np.where(np.isin(splits, ["train", "seen_test"]), "train", splits)
    assert {name: int((by_anatomy[:, 0] == name).sum()) for name in ("train", "calibrate", "test")} == {
        "train": 60,
        "calibrate": 20,
        "test": 20,
    }
    assert (splits == "seen_test").sum() == 60 * 2


@pytest.mark.parametrize("shares", [None, (2 / 3, 0.0, 1 / 3), (0.5, 0.5, 0.0)])
def test_no_anatomy_leaks(shares):
    splits = assign_splits(NAMES[:13], 20, anatomy_shares=shares)
    for row in splits:
        held = set(row.tolist())
        assert held <= {"train", "seen_test"} or len(held) == 1


def test_order_of_the_anatomies_does_not_matter():
    splits = assign_splits(NAMES, 7)
    assert (assign_splits(NAMES[::-1], 7)[::-1] == splits).all()


def test_the_split_is_that_of_the_hash():
    first = sorted(NAMES, key=lambda name: hashlib.sha256(name.encode()).digest())[:60]
    splits = assign_splits(NAMES, 2)
    trained = {name for name, row in zip(NAMES, splits, strict=True) if row[0] in ("train", "seen_test")}
    assert trained == set(first)


def test_one_patient_is_split_by_sequence():
    splits = assign_splits(["only"], 10)
    assert sorted(splits[0].tolist()) == ["seen_test"] * 2 + ["train"] * 8


def test_every_requested_split_gets_an_anatomy():
    splits = assign_splits(NAMES[:3], 5)
    assert {"train", "calibrate", "test"} <= set(splits.ravel().tolist())


def test_too_few_anatomies_are_refused_with_advice():
    with pytest.raises(InputError, match=r"2 anatomies cannot fill 3 splits.*at least 3"):
        assign_splits(NAMES[:2], 5)


def test_one_sequence_cannot_be_split():
    with pytest.raises(InputError, match="sequences: 1 cannot be split"):
        assign_splits(NAMES[:1], 1)
    assert assign_splits(NAMES[:1], 1, seen_test_share=0.0).tolist() == [["train"]]
