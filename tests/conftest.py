"""Skips what needs a library that is not installed, and gives toy data: a dataset, a vessel, predictions."""

from __future__ import annotations

import gc
import locale
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from missing_libraries import missing_library
from shape_checks import begin_test, check_quickly

check_quickly()
gc.disable()  # while all is imported, and nothing is garbage

LOCALE, ENCODING = locale.setlocale(locale.LC_ALL), locale.getencoding()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Skip a module that needs a library which is not installed."""
    report = yield
    error = report.call.excinfo.value if report.failed and report.call.excinfo else None
    if reason := missing_library(error):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, f"Skipped: {reason}")
    return report


def pytest_collection_finish():
    """Leave what is imported out of garbage collection, and collect seldom: it takes up to a tenth of some tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    """Skip a test whose fixtures need such a library."""
    begin_test()
    return (yield from skipping())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """Skip a test that needs such a library."""
    return (yield from skipping())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown():
    """Fail a test that leaves another encoding of text files to the tests after it, as ITK's writer of DICOM does."""
    result = yield
    if locale.getencoding() != ENCODING:
        left = locale.getencoding()
        locale.setlocale(locale.LC_ALL, LOCALE)
        pytest.fail(f"leaves the locale's encoding at {left}; it was {ENCODING}")
    return result


def skipping():
    """Go on with a hook, and skip the test if it fails for want of a library."""
    try:
        return (yield)
    except Exception as error:
        if reason := missing_library(error):
            pytest.skip(reason)
        raise


@pytest.fixture(scope="session", autouse=True)
def here():
    """Let work on several items be done in this process, and make each of the tasks' patients once: both save time."""
    from functools import lru_cache

    from endopilot import parallel
    from endopilot.tasks import task

    make_patient = lru_cache(maxsize=12)(task.make_patient)
    with patch.object(parallel, "MOST_PROCESSES", 1), patch.object(task, "make_patient", make_patient):
        yield


@pytest.fixture(scope="session", autouse=True)
def refusals():
    """Let no refusal have two lines: the command line prints each in one."""
    from endopilot.errors import InputError

    def begin(self, *message):
        assert not any("\n" in str(part) for part in message), message
        Exception.__init__(self, *message)

    with patch.object(InputError, "__init__", begin):
        yield


@pytest.fixture
def in_processes(monkeypatch):
    """Let work on several items be done in processes of their own, as for users."""
    from endopilot import parallel

    monkeypatch.setattr(parallel, "MOST_PROCESSES", 2)


@pytest.fixture(scope="session")
def toy_dataset(tmp_path_factory):
    """Return the folder of a dataset of six toy patients with 24 navigations each; do not write into it."""
    from toy_navigation import make_toy_dataset  # here, so that endopilot is imported after its shape checks are on

    folder = tmp_path_factory.mktemp("toy") / "dataset"
    make_toy_dataset(folder, patients=6, sequences=24)
    return folder


@pytest.fixture(scope="session")
def anatomy():
    """Return a bent tube with a guiding catheter."""
    from toy_evaluation import make_anatomy

    return make_anatomy()


@pytest.fixture(scope="session")
def rollout():
    """Return one world whose wire lies on the axis and goes deeper each sample."""
    from toy_evaluation import make_trajectory

    return make_trajectory()


@pytest.fixture(scope="session")
def results():
    """Return predictions on known and on new patients, whose errors differ by series."""
    from toy_evaluation import make_result

    return {"seen_test": make_result(), "test": make_result(("c",), seed=4)}


@pytest.fixture(scope="session")
def evaluated(toy_dataset, tmp_path_factory):
    """Return a folder that holds an untrained run and its evaluation, and the metrics; do not write into it."""
    import torch

    from endopilot.evaluation.evaluate import EvaluateConfig, evaluate
    from toy_navigation import make_untrained_run, toy_run

    folder = tmp_path_factory.mktemp("evaluated")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small batches gain nothing from two, and lose much where cores are shared
    make_untrained_run(toy_dataset, folder / "run")
    with patch("endopilot.dataset.loader.run_set_up", toy_run):
        settings = EvaluateConfig(sequences=8)
        metrics = evaluate(folder / "run", output=folder / "evaluation", config=settings, other_seeds=[folder / "run"])
    torch.set_num_threads(threads)
    return folder, metrics


@pytest.fixture(scope="session")
def fork():
    """Return a straight vessel with a side branch."""
    from toy_fork import make_fork

    return make_fork()


@pytest.fixture(scope="session")
def wire():
    """Return the workhorse wire."""
    from endopilot.devices.device import read_wire

    return read_wire("workhorse-014")


@pytest.fixture(scope="session")
def shaped(wire):
    """Return the workhorse wire with a tip of 70° over 4 mm."""
    return replace(wire.with_tip(bend_rad=np.deg2rad(70.0), stiffness_factor=1.0), tip_bend_length_mm=4.0)


@pytest.fixture(scope="session")
def side_branch(fork, shaped):
    """Return a navigation of that wire into the side branch."""
    from endopilot.tasks.navigation import Navigation, Target

    return Navigation(anatomy=fork, device=shaped, target=Target(branch=2, abscissa=33.0), seconds=40.0)


@pytest.fixture(scope="session")
def with_play():
    """Return a robot whose encoders do not see a play of 2.6 mm and 0.9 turn; a seed draws both, ± 15 %."""
    from endopilot.devices.robot import DriveConfig, RobotConfig

    wire = DriveConfig(play_mm=2.6, play_rad=2 * np.pi * 0.9, play_sd_share=0.15)
    return RobotConfig(encoders_at="motor", wire=wire)


@pytest.fixture(scope="session")
def vessel(fork, tmp_path_factory):
    """Return the folder of the vessel."""
    from endopilot.anatomy.io import write_anatomy

    folder = tmp_path_factory.mktemp("vessel") / "fork"
    write_anatomy(fork, output=folder)
    return folder


@pytest.fixture(scope="session")
def patient(tmp_path_factory):
    """Return the folder of a synthetic right coronary artery; do not write into it."""
    from endopilot.anatomy.io import write_anatomy
    from endopilot.atlas.atlas import AtlasConfig, make_patient

    folder = tmp_path_factory.mktemp("anatomies") / "patient"
    write_anatomy(make_patient(AtlasConfig(count=1, seed=4, population="textbook"), 0), output=folder)
    return folder


@pytest.fixture(scope="session")
def found(vessel):
    """Return a plan along the vessel, made by trial in the rod core."""
    from endopilot.control.plan import plan
    from endopilot.control.plan_config import PlanConfig

    return plan(vessel, "0,0,33", config=PlanConfig(seconds=30.0, start_rotation_rad=0.1, seed=4))
