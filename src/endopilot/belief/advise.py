"""Calibrate a run's X-ray adviser, and measure it on new patients: `advise`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from endopilot import __version__
from endopilot.belief import monitoring
from endopilot.belief.bands import CALIBRATION_FILE, Calibration, check_enough
from endopilot.belief.monitoring import AdviseConfig, Monitored
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.errors import InputError
from endopilot.files import manifest, write_json, writing
from endopilot.models.config import WINDOW, WIRES, read_run, run_inputs
from endopilot.models.episodes import check_wire
from endopilot.progress import progress
from endopilot.runs import claim

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES_FILE, PICTURE_FILE = "advice.json", "advice.png"
PERIODS = (1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 45, 90)
"""Samples between two exposures of periodic imaging."""
SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.5)
"""Shares of γtip's band that the adviser uses, for its curve; the calibrated one is measured too."""


def advise(
    run: Path, dataset: Path, output: Path, config: AdviseConfig, *, also_test: Sequence[Path] = ()
) -> dict[str, Any]:
    """Calibrate the X-ray adviser of a run on a dataset's calibration patients, and measure it on its test patients.

    Writes the calibration beside the run (`xray.json`; of simulated wires, to the output), and `advice.json` and
    `advice.png` to the output, each whole or not at all.

    Args:
        run: made by `endopilot train`, or "wires", the simulated wires.
        dataset: made by `endopilot dataset`; its patients must not be those that the run was trained on, unless they
            are of its split 'train'.
        also_test: datasets of the same wire that were made otherwise, with another wall or other elements: their test
            patients are advised with the same calibration, and measured apart.

    Returns:
        The content of `advice.json`.

    Raises:
        InputError: the run or a dataset is missing or damaged, they are of different wires, there are too few
            calibration patients, or too few that can be registered in images, or one of `also_test` tests on patients
            that the bands are fitted to.
    """
    from endopilot.models.checkpoint import load_model  # brings torch
    from endopilot.plotting import png  # brings matplotlib, which takes a second to import

    start = time.perf_counter()
    beside = output if str(run) == WIRES else run
    episodes, predictor = read_dataset(dataset), load_model(run)
    check_wire(run, read_run(run), episodes)
    splits = [episodes.of_split(name) for name in ("train", "calibrate", "test")]
    check_enough(len(set(splits[1].anatomy)), config.adviser.level)
    others = [_other(run, folder, splits[:2]) for folder in also_test]
    inputs = run_inputs(run) | {"dataset": episodes.manifest["key"]}
    inputs |= {"also_test": [other.manifest["key"] for other in others]}
    claim(output, "endopilot advise", inputs=inputs, config=config, version=__version__)
    fitted = monitoring.monitor(predictor, splits[0], config, samples=WINDOW)
    own, test = (monitoring.monitor(predictor, split, config) for split in splits[1:])
    check_enough(len(set(own.episodes.anatomy)), config.adviser.level)
    calibration = monitoring.calibrate(fitted, own, config.adviser)
    shares = sorted({*SHARES, calibration.offset_share})
    with progress("Advising", len(PERIODS) + len(shares) + 1) as advance:

        def measured(policy: monitoring.ExposurePolicy) -> dict[str, float]:
            point = monitoring.measure_policy(test, policy, config.adviser)
            advance()
            return point

        curves = {"periodic": [measured(monitoring.periodic_policy(test, period)) for period in PERIODS]}
        bands = {share: replace(calibration, offset_share=share) for share in shares}
        curves["adviser"] = [
            {"offset_share": share} | measured(monitoring.adviser_policy(test, each, config.adviser))
            for share, each in bands.items()
        ]
        curves["oracle"] = [measured(monitoring.oracle_policy(test, config.adviser))]
    otherwise = [
        _measure_otherwise(monitoring.monitor(predictor, other, config), other, episodes, calibration, config)
        for other in others
    ]
    at = next(point for point in curves["adviser"] if point["offset_share"] == calibration.offset_share)
    equal = monitoring.periodic_equal(curves["periodic"], at["missed_share"])
    content = {
        "calibration": calibration,
        "coverage": monitoring.coverage(test, calibration),
        "coverage_of_calibration_patients": monitoring.coverage(own, calibration),
        "adviser": at,
        "metronome": monitoring.measure_metronome(test, at["exposures_per_minute"], config.adviser),
        "periodic_exposures_per_minute_with_the_same_missed_share": equal,
        "share_of_the_exposures_of_periodic_imaging": at["exposures_per_minute"] / equal,
        "curves": curves,
        "made_otherwise": otherwise,
        "patients_not_registered": [*fitted.unregistered, *own.unregistered, *test.unregistered],
        "images_without_a_wire_share": float(1 - test.found.mean()),
        "manifest": manifest(
            config=config,
            seed=config.seed,
            inputs={
                "run": str(run),
                "dataset": episodes.manifest["key"],
                **{f"also_test {other.folder}": other.manifest["key"] for other in others},
            },
            wall_seconds=time.perf_counter() - start,
        ),
    }
    (output / FIGURES_FILE).unlink(missing_ok=True)
    with writing(output / PICTURE_FILE) as partial:
        partial.write_bytes(png(_picture(content)))
    calibration.write(beside)
    write_json(output / FIGURES_FILE, content | {"calibration_file": str(beside / CALIBRATION_FILE)})
    return content


def _other(run: Path, folder: Path, ours: Sequence[Dataset]) -> Dataset:
    """Return the test patients of a dataset that was made otherwise.

    Args:
        ours: what the bands are fitted to and scaled on.

    Raises:
        InputError: it is of another wire, or tests on patients of `ours`.
    """
    made = read_dataset(folder)
    check_wire(run, read_run(run), made)
    test = made.of_split("test")
    fitted = {split.patients[name] for split in ours for name in split.anatomy.tolist()}
    both = sorted({name for name in test.anatomy.tolist() if test.patients[name] in fitted})
    if both:
        raise InputError(
            f"{folder}: tests on {', '.join(both[:3])}{' ...' if len(both) > 3 else ''}, which the bands are fitted "
            "to; make it of other patients, or of the first dataset's test patients alone"
        )
    return test


def _measure_otherwise(
    test: Monitored, made: Dataset, calibrated: Dataset, calibration: Calibration, config: AdviseConfig
) -> dict[str, Any]:
    """Return what the calibrated adviser misses and costs on navigations that were made otherwise, and how."""
    theirs, ours = (_leaves(data.manifest["config"]) for data in (made, calibrated))
    cover = monitoring.coverage(test, calibration)
    adviser = monitoring.measure_policy(
        test, monitoring.adviser_policy(test, calibration, config.adviser), config.adviser
    )
    return {
        "dataset": str(made.folder),
        "differs": {name: value for name, value in theirs.items() if value != ours.get(name)},
        "coverage": cover,
        "adviser": adviser,
        "metronome": monitoring.measure_metronome(test, adviser["exposures_per_minute"], config.adviser),
    }


def _leaves(record: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the settings in a record of nested settings, by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in record.items():
        found |= _leaves(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return found


def _picture(content: Mapping[str, Any]) -> Figure:
    """Draw exposures a minute against the share of events that is missed."""
    import matplotlib
    from matplotlib.figure import Figure

    from endopilot.plotting import BLACK, BLUE, GREY, STYLE, VERMILLION

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.add_subplot()
        lines = (
            ("periodic", GREY, "Periodic imaging"),
            ("adviser", BLUE, "Adviser that uses less or more of γtip's band"),
        )
        for name, color, label in lines:
            curve = content["curves"][name]
            points = sorted((point["exposures_per_minute"], 100 * point["missed_share"]) for point in curve)
            axes.plot(*zip(*points, strict=True), color=color, marker="o", markersize=3.5, label=label)
        marks = (
            (
                content["adviser"],
                "o",
                VERMILLION,
                f"Adviser as calibrated: {content['calibration'].offset_share:g} of γtip's band",
            ),
            (content["curves"]["oracle"][0], "*", BLACK, "Oracle"),
        )
        for point, marker, color, label in marks:
            place = point["exposures_per_minute"], 100 * point["missed_share"]
            axes.plot(*place, marker, color=color, markersize=9, label=label)
        axes.axhline(5, color=BLACK, lw=0.9, ls=(0, (4, 3)))
        axes.set(xlabel="Exposures a minute (fluoroscopy at 7.5 Hz: 450)", ylabel="Events missed, %")
        axes.set(xlim=(0, 62), ylim=(-1, None))
        axes.legend()
    return figure
