from __future__ import annotations

import shutil

import pandas as pd
import pytest

from endopilot.errors import InputError
from endopilot.evaluation.results import METRICS_FILE, RESULTS_FILE
from endopilot.report.report import report_evaluation


@pytest.fixture(scope="module")
def reported(evaluated, tmp_path_factory):
    folder, metrics = evaluated
    copy = tmp_path_factory.mktemp("reported")
    for name in (RESULTS_FILE, METRICS_FILE):
        shutil.copy(folder / "evaluation" / name, copy)
    report_evaluation(copy)
    return copy, folder / "run", metrics


@pytest.mark.parametrize("name", ["tip_error", "safety_ratio", "control_error", "drive_difference"])
def test_every_figure_has_its_table(reported, name):
    folder = reported[0] / "figures"
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert set(pd.read_csv(folder / f"{name}.csv")["split"]) == {"seen_test", "test"}


def test_the_evaluation_ends_with_a_report_that_needs_nothing_beside_it(reported):
    folder, run, metrics = reported
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert 'src="data:image/png' in page
    assert 'src="http' not in page
    assert f"endopilot evaluate {run} -o {folder}" in page
    assert f"{metrics['splits']['test']['tip']['P4']['abscissa']['0-10']['mae']:.2f}" in page


def test_a_folder_without_an_evaluation_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"metrics\.json: no such file"):
        report_evaluation(tmp_path)
    assert not any(tmp_path.iterdir())
