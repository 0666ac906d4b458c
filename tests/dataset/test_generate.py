"""The dataset on disk: splits, resumption, what is refused, joined sets, a cluster, and LeRobot's own reader."""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from endopilot import __version__
from endopilot.anatomy.io import write_anatomy
from endopilot.dataset import layout
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.info import describe_dataset, draw_pictures
from endopilot.dataset.layout import assign_splits
from endopilot.dataset.loader import read_dataset, read_joined
from endopilot.errors import InputError
from endopilot.files import read_json, sha256, write_json
from endopilot.simulation.motion import Motion
from read_by_lerobot import read_by_lerobot
from toy_navigation import make_toy_dataset, toy_anatomy, toy_simulate


def data_hashes(folder: Path) -> dict[str, str]:
    """Return the hashes of everything that must not depend on how often a run was interrupted."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "manifest.json"]
    return {str(path.relative_to(folder)): sha256(path) for path in files}


def test_pandas_reads_the_layout_of_lerobot(toy_dataset):
    info = read_json(toy_dataset / "meta/info.json")
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (144, 144 * 120, 2)
    episodes = pd.concat(pd.read_parquet(p) for p in sorted((toy_dataset / "meta/episodes").glob("*/*.parquet")))
    assert episodes["episode_index"].tolist() == list(range(144))
    last = episodes.iloc[-1]
    where = {"chunk_index": last["data/chunk_index"], "file_index": last["data/file_index"]}
    samples = pd.read_parquet(toy_dataset / info["data_path"].format(**where))
    rows = samples[(samples["index"] >= last["dataset_from_index"]) & (samples["index"] < last["dataset_to_index"])]
    assert (rows["episode_index"] == 143).all()
    assert rows["frame_index"].tolist() == list(range(120))
    np.testing.assert_allclose(rows["timestamp"], np.arange(120) / 2)
    assert set(samples.columns) == set(info["features"])
    for name, feature in info["features"].items():
        assert np.atleast_1d(samples[name].iloc[0]).shape == tuple(feature["shape"]), name
        assert np.atleast_1d(samples[name].iloc[0]).dtype == feature["dtype"], name
    tasks = pd.read_parquet(toy_dataset / "meta/tasks.parquet")
    assert tasks.loc[last["tasks"][0], "task_index"] == samples["task_index"].iloc[0]


def test_statistics_are_those_of_the_samples(toy_dataset):
    data, stats = read_dataset(toy_dataset), read_json(toy_dataset / "meta/stats.json")
    flat = data.control.reshape(-1, 2).astype(float)
    np.testing.assert_allclose(stats["action"]["mean"], flat.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(stats["action"]["std"], flat.std(axis=0), rtol=1e-9)
    assert stats["action"]["min"] == flat.min(axis=0).tolist()
    assert stats["action"]["count"] == [144 * 120]


def test_bits_do_not_depend_on_how_sequences_are_put_into_files(tmp_path, toy_dataset):
    make_toy_dataset(tmp_path / "small-files", patients=6, sequences=24, sequences_per_file=7)
    whole, split = read_dataset(toy_dataset), read_dataset(tmp_path / "small-files")
    assert split.manifest["files"] == 6 * 4
    for name in ("control", "tip_abscissa", "friction", "initial", "split", "anatomy"):
        assert (getattr(whole, name) == getattr(split, name)).all(), name


def test_killed_and_resumed_gives_the_same_bits(tmp_path):
    settings = {"patients": 2, "sequences": 20, "sequences_per_file": 5}
    make_toy_dataset(tmp_path / "whole", **settings)
    script = (
        f"import sys, time; sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from toy_navigation import make_toy_dataset, toy_simulate\n"
        "def slowly(*args, **kwargs):\n"
        "    time.sleep(0.2)\n"
        "    return toy_simulate(*args, **kwargs)\n"
        f"make_toy_dataset(Path({str(tmp_path / 'killed')!r}), simulate=slowly, **{settings!r})\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while len(list((tmp_path / "killed").glob("data/*/file-*.parquet"))) < 4:
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    with pytest.raises(InputError, match="unfinished"):
        read_dataset(tmp_path / "killed")
    (tmp_path / "killed/data/chunk-000/.part-1-file-007.parquet").write_bytes(b"cut off by the kill")
    make_toy_dataset(tmp_path / "killed", **settings)
    assert data_hashes(tmp_path / "killed") == data_hashes(tmp_path / "whole")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "whole").rglob("*")}
    make_toy_dataset(tmp_path / "whole", **settings)  # finished, it is left alone
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "whole").rglob("*")} == before
    with pytest.raises(InputError, match=r"no valid episode in split 'calibrate' \(it has seen_test, test, train\)"):
        read_dataset(tmp_path / "whole").of_split("calibrate")


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("data/chunk-000/file-001.parquet", None),
        ("data/chunk-000/file-001.parquet", -50),
        ("meta/episodes/chunk-000/file-000.parquet", 0),
        ("meta/info.json", None),
        ("meta/stats.json", -50),
        ("meta/tasks.parquet", -50),
    ],
)
def test_a_lost_or_cut_file_is_made_again(tmp_path, name, kept):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4, sequences_per_file=2)
    before, file = data_hashes(tmp_path / "d"), tmp_path / "d" / name
    content = file.read_bytes()
    if kept is None:
        file.unlink()
    else:
        file.write_bytes(content[:kept])
    if file.name not in ("stats.json", "tasks.parquet"):  # which are for others alone
        with pytest.raises(InputError, match=rf"{file.name}: (missing|damaged)"):
            read_dataset(tmp_path / "d")
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4, sequences_per_file=2)
    assert data_hashes(tmp_path / "d") == before and file.read_bytes() == content


def test_another_anatomy_in_the_place_of_the_dataset_s_own_is_refused(tmp_path):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4)
    data, folder = read_dataset(tmp_path / "d"), tmp_path / "anatomies/patient-0"
    assert data.anatomy_folder("patient-0") == folder.resolve()
    write_anatomy(replace(toy_anatomy("patient-0"), catheter_radius_mm=1.0), output=folder)
    with pytest.raises(InputError, match="is not the anatomy that"):
        data.anatomy_folder("patient-0")


def test_other_settings_are_refused_by_name(tmp_path):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4)
    with pytest.raises(InputError, match=r"config\.sequences = 4, now it is 5"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=5)
    write_anatomy(replace(toy_anatomy("patient-0"), catheter_radius_mm=1.0), output=tmp_path / "anatomies/patient-0")
    with pytest.raises(InputError, match=r"anatomies\.patient-0 ="):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4)


def test_two_anatomies_of_one_name_are_refused(tmp_path):
    for folder in ("patient-0", "patient-1"):
        write_anatomy(toy_anatomy("twin"), output=tmp_path / "anatomies" / folder)
    with pytest.raises(InputError, match="2 are named 'twin'"):
        make_toy_dataset(tmp_path / "d", patients=2, sequences=4)
    assert not (tmp_path / "d").exists()


def test_invalid_worlds_are_listed_and_never_trained_on(tmp_path):
    def failing(*args, **kwargs):
        trajectory = toy_simulate(*args, **kwargs)
        trajectory.valid[3, 50:] = False
        trajectory.reason[3] = 2
        trajectory.tip.abscissa[3, 50:] = np.nan
        return trajectory

    make_toy_dataset(tmp_path / "d", patients=1, sequences=10, simulate=failing)
    record = read_json(tmp_path / "d/meta/manifest.json")["invalid"]
    assert record["episodes"] == 1
    assert record["which"][0]["sequence"] == 3
    assert record["which"][0]["invalid_reason"] == "did not converge after 25 s"
    data = read_dataset(tmp_path / "d")
    assert not data.valid[3].all()
    for split in ("train", "seen_test"):
        assert 3 not in data.of_split(split).sequence
        assert np.isfinite(data.of_split(split).tip_abscissa).all()
    stats = read_json(tmp_path / "d/meta/stats.json")["observation.state"]
    assert np.isfinite(stats["mean"]).all()
    assert stats["count"] == [10 * 120 - 70]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("seconds", 0.7),
        ("friction", (0.2, 0.1)),
        ("anatomy_shares", (0.0, 0.5, 0.4)),
        ("anatomy_shares", (0.5, 0.1, 0.1)),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(InputError, match=rf"^{field}[:\[]"):
        DatasetConfig(**{field: value})


def test_loader_names_what_is_damaged(tmp_path):
    with pytest.raises(InputError, match="no dataset here"):
        read_dataset(tmp_path)
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4, sequences_per_file=2)
    make_toy_dataset(tmp_path / "other", patients=1, sequences=4, sequences_per_file=2, seed=9)
    file = tmp_path / "d/data/chunk-000/file-001.parquet"
    whole = file.read_bytes()

    file.write_bytes((tmp_path / "other/data/chunk-000/file-001.parquet").read_bytes())
    with pytest.raises(InputError, match=r"file-001\.parquet: written by another version or with other settings"):
        read_dataset(tmp_path / "d")
    file.write_bytes(whole)
    info = read_json(tmp_path / "d/meta/info.json")
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(InputError, match=r"codebase_version is v2\.1"):
        read_dataset(tmp_path / "d")
    (tmp_path / "d/meta/info.json").write_text(json.dumps(info))
    manifest = read_json(tmp_path / "d/meta/manifest.json")
    older = manifest["settings"] | {"version": "endopilot 0.0.9, format 1"}
    (tmp_path / "d/meta/manifest.json").write_text(json.dumps(manifest | {"settings": older}))
    with pytest.raises(InputError, match=r"made by endopilot 0\.0\.9, format 1, which .* cannot read"):
        read_dataset(tmp_path / "d")
    for name, odd in (("settings", None), ("anatomies", "x"), ("files", []), ("key", 3), ("samples_per_episode", None)):
        (tmp_path / "d/meta/manifest.json").write_text(json.dumps(manifest | {name: odd}))
        with pytest.raises(InputError, match="; make the dataset again"):
            read_dataset(tmp_path / "d")


def test_another_version_of_the_package_is_refused(tmp_path, monkeypatch):
    make_toy_dataset(tmp_path / "d", patients=1, sequences=4)
    monkeypatch.setattr(layout, "__version__", "99.0")
    with pytest.raises(InputError, match=rf"was begun with version = endopilot {__version__}, .*endopilot 99\.0"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4)


def test_a_cluster_gives_the_same_bits(tmp_path):
    distributed = pytest.importorskip("distributed", reason="pip install 'endopilot[cluster]'")
    settings = {"patients": 3, "sequences": 20, "sequences_per_file": 5}
    make_toy_dataset(tmp_path / "here", **settings)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, local_directory=tmp_path / "space"
    ) as cluster:
        make_toy_dataset(tmp_path / "there", scheduler=cluster.scheduler_address, **settings)
    assert data_hashes(tmp_path / "there") == data_hashes(tmp_path / "here")


def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="pip install 'endopilot[cluster]'")
    monkeypatch.setattr("endopilot.dataset.generate._CONNECT_TIMEOUT_S", 1)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9 cannot be reached"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"endopilot\[cluster\]"):
        make_toy_dataset(tmp_path / "d", patients=1, sequences=4, scheduler="tcp://127.0.0.1:9")


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
