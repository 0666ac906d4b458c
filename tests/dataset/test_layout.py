"""Splits, joined datasets, their figures, and LeRobot's own reader."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from endopilot.dataset.info import describe_dataset, draw_pictures
from endopilot.dataset.layout import assign_splits
from endopilot.dataset.loader import read_dataset, read_joined
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.simulation.motion import Motion
from read_by_lerobot import read_by_lerobot
from toy_navigation import make_toy_dataset, toy_simulate


def test_lerobot_reads_a_dataset(toy_dataset):
    read, data = read_by_lerobot(toy_dataset, 250), read_dataset(toy_dataset)
    assert (read["samples"], read["episodes"], read["fps"]) == (144 * 120, 144, 2)
    assert read["task"] == "random navigation" and read["images"] == {}
    assert read["names"] == ["translation_mm_s", "rotation_rad_s"]
    assert read["episode"] == 2
    np.testing.assert_array_equal(np.float32(read["action"]), data.control[2, 10, 0])
    np.testing.assert_array_equal(
        np.float32(read["state"][2:]), [data.tip_abscissa[2, 10, 0], data.tip_offset[2, 10, 0]]
    )
    np.testing.assert_allclose(read["mean"], data.control.reshape(-1, 2).mean(axis=0), rtol=1e-3, atol=1e-5)


NAMES = [f"patient-{i:03d}" for i in range(100)]


@pytest.mark.parametrize("shares", [(0.6, 0.2, 0.2), (2 / 3, 0.0, 1 / 3)])
def test_patients_are_shared_out_by_the_hash_of_their_names(shares):
    splits = assign_splits(NAMES, 10, anatomy_shares=shares)
    assert (assign_splits(NAMES[::-1], 10, anatomy_shares=shares)[::-1] == splits).all()
    ranked = sorted(range(100), key=lambda k: hashlib.sha256(NAMES[k].encode()).digest())
    train, rest = np.split(splits[ranked], [round(100 * shares[0])])
    assert ((train == "seen_test").sum(axis=1) == 2).all() and ((train == "train").sum(axis=1) == 8).all()
    names, counts = np.unique(rest, return_counts=True)
    expected = {
        name: 10 * round(100 * share) for name, share in zip(("calibrate", "test"), shares[1:], strict=True) if share
    }
    assert dict(zip(names.tolist(), counts.tolist(), strict=True)) == expected
    assert all(len(set(row.tolist())) == 1 for row in rest)


def test_few_patients_and_few_sequences():
    assert sorted(assign_splits(["only"], 10)[0].tolist()) == ["seen_test"] * 2 + ["train"] * 8
    assert assign_splits(["only"], 1, seen_test_share=0.0).tolist() == [["train"]]
    with pytest.raises(InputError, match=r"2 anatomies cannot fill 3 splits.*at least 3"):
        assign_splits(NAMES[:2], 5)
    with pytest.raises(InputError, match="sequences: 1 cannot be split"):
        assign_splits(NAMES[:1], 1)


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


def failing(*args, **kwargs):
    trajectory = toy_simulate(*args, **kwargs)
    trajectory.valid[1, 5:] = False
    trajectory.reason[1] = 2
    return trajectory


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("info") / "d"
    make_toy_dataset(folder, patients=3, sequences=10, sequences_per_file=6, simulate=failing)
    return folder


def test_figures_are_those_of_the_samples(folder):
    data, figures = read_dataset(folder), describe_dataset(folder).figures
    assert (figures["anatomies"], figures["navigations"], figures["samples"]) == (3, 30, 3600)
    assert figures["hours"] == 0.5
    assert figures["splits"] == {name: int((data.split == name).sum()) for name in set(data.split.tolist())}
    valid = data.valid
    for name, values in (
        ("inserted length Δ mm", data.inserted_length),
        ("offset ratio γ/r", data.tip_offset / data.lumen_radius),
        ("offset ratio γ/(r − r_w)", data.tip_offset / (data.lumen_radius - 0.18)),
        ("largest contact force N", data.contact_force_max),
    ):
        for quantile, share in (("p5", 5), ("median", 50), ("p95", 95)):
            assert figures[name][quantile] == pytest.approx(np.percentile(values[valid], share), abs=2e-5), name
    assert figures["branches visited"] == {"1": 1.0}
    velocity = data.control[valid][:, 0]
    assert figures["manoeuvres"]["insertion"] == pytest.approx((velocity[:, 0] > 0.1).mean(), abs=1e-4)
    assert min(figures["manoeuvres"].values()) > 0
    assert sum(figures["manoeuvres"].values()) == pytest.approx(1, abs=3e-4)
    assert figures["invalid"] == 6  # the second navigation of each of six files
    assert figures["invalid_reasons"] == {"did not converge": 6}


def test_every_distribution_has_a_picture(folder, tmp_path):
    paths = draw_pictures(describe_dataset(folder), tmp_path / "pictures")
    names = {"insertion", "offset-ratio", "wall-ratio", "contact-force", "branches", "manoeuvres"}
    assert {path.stem for path in paths} == names
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)
