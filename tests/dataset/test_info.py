"""What `endopilot dataset-info` says is what the files hold."""

from __future__ import annotations

import json

import numpy as np
import pytest

from endopilot.cli import main
from endopilot.dataset.info import describe_dataset, draw_pictures
from endopilot.dataset.loader import read_dataset
from toy_navigation import make_toy_dataset, toy_simulate


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
    for name, values, step in (
        ("inserted length Δ mm", data.inserted_length, 0.25),
        ("offset ratio γ/r", data.tip_offset / data.lumen_radius, 0.003),
        ("offset ratio γ/(r − r_w)", data.tip_offset / (data.lumen_radius - 0.18), 0.003),
        ("largest contact force N", data.contact_force_max, 0.002),
    ):
        for quantile, share in (("p5", 5), ("median", 50), ("p95", 95)):
            expected = np.percentile(np.clip(values[valid], 0, None if "ratio" not in name else 1.2), share)
            assert figures[name][quantile] == pytest.approx(expected, abs=step), (name, quantile)
    assert figures["branches visited"] == {"1": 1.0}


def test_manoeuvres_are_those_that_were_driven(folder):
    data = read_dataset(folder)
    velocity = data.control[data.valid][:, 0]
    shares = describe_dataset(folder).figures["manoeuvres"]
    assert shares["insertion"] == pytest.approx((velocity[:, 0] > 0.1).mean(), abs=1e-4)
    assert shares["retraction"] == pytest.approx((velocity[:, 0] < -0.1).mean(), abs=1e-4)
    still = np.abs(velocity[:, 0]) <= 0.1
    assert shares["pause"] == pytest.approx((still & (np.abs(velocity[:, 1]) <= 0.02)).mean(), abs=1e-4)
    assert min(shares.values()) > 0
    assert sum(shares.values()) == pytest.approx(1, abs=3e-4)


def test_failures_are_counted_with_their_reason(folder):
    figures = describe_dataset(folder).figures
    assert figures["invalid"] == 6  # the second navigation of each of six files
    assert figures["invalid_reasons"] == {"did not converge": 6}


def test_every_distribution_has_a_picture(folder, tmp_path):
    paths = draw_pictures(describe_dataset(folder), tmp_path / "pictures")
    names = {"insertion", "offset-ratio", "wall-ratio", "contact-force", "branches", "manoeuvres"}
    assert {path.stem for path in paths} == names
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_the_command_prints_json_and_names_what_is_missing(folder, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["dataset-info", str(folder), "--json"])
    assert json.loads(capsys.readouterr().out)["navigations"] == 30
    with pytest.raises(SystemExit) as leaving:
        main(["dataset-info", str(tmp_path)])
    assert leaving.value.code == 2
    assert "no dataset here" in capsys.readouterr().err
