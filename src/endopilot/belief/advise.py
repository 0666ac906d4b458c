"""Calibrate a run's X-ray adviser, and measure it on new patients: `advise`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from endopilot.belief import monitoring
from endopilot.belief.bands import CALIBRATION_FILE, Calibration, check_enough
from endopilot.belief.monitor import Monitor
from endopilot.belief.monitoring import AdviseConfig, follow_all, measure
from endopilot.belief.network_monitor import NetworkMonitor
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.errors import InputError
from endopilot.files import manifest, write_json, writing
from endopilot.models.config import WINDOW, WIRES, read_run, run_inputs
from endopilot.models.episodes import check_wire
from endopilot.runs import claim

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES_FILE, PICTURE_FILE = "advice.json", "advice.png"


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
    from endopilot.plotting import png  # brings matplotlib, which takes a second to import

    start = time.perf_counter()
    beside = output if str(run) == WIRES else run
    data, model = read_dataset(dataset), follows(run)
    check_wire(run, read_run(run), data)
    if str(run) == WIRES and (around := ", ".join(each.name for each in data.stack.catheters)):
        raise InputError(f"{dataset}: its wire lies in {around}; make it without --catheter for {WIRES}, or name a run")
    fit, calibrating, test = (data.of_split(name) for name in ("train", "calibrate", "test"))
    check_enough(len(set(calibrating.anatomy)), config.adviser.level)
    others = [_other(run, folder, (fit, calibrating)) for folder in also_test]
    inputs = run_inputs(run) | {"dataset": data.manifest["key"]}
    inputs |= {"also_test": [other.manifest["key"] for other in others]}
    claim(output, "endopilot advise", inputs=inputs, config=config)
    (fitted, left_out), (own, left_out_too) = (follow_all(part, model, config) for part in (fit, calibrating))
    bands = monitoring.calibrate(fitted, own, config.adviser.level, data.manifest["key"])
    onset, curve = monitoring.greatest_onset(
        lambda tried: follow_all(calibrating, model, config, tried)[0], bands, config.adviser.missed
    )
    calibration = replace(bands, onset=onset)
    found, left_out_of_test = follow_all(test, model, config, calibration)
    at = measure(found)
    content = {
        "calibration": calibration,
        "coverage": monitoring.coverage(found),
        "adviser": {"onset": onset} | at,
        "share_of_the_exposures_of_periodic_imaging": at["exposures_per_minute"]
        / max(at["periodic_exposures_per_minute_with_the_same_missed_share"], 1e-9),
        "curves": {"adviser": curve},
        "made_otherwise": [_measure_otherwise(other, data, model, calibration, config) for other in others],
        "patients_not_registered": [*left_out, *left_out_too, *left_out_of_test],
        "manifest": manifest(
            config=config,
            seed=config.seed,
            inputs={
                "run": str(run),
                "dataset": data.manifest["key"],
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


def follows(run: Path) -> monitoring.Follows:
    """Return what makes what follows a navigation: the agent's belief (`wires`), or the networks of a run."""
    if str(run) == WIRES:
        return lambda navigation, bands, advice: Monitor(navigation, bands, advice=advice, settles=WINDOW)
    from endopilot.models.checkpoint import load_model  # brings torch

    return partial(NetworkMonitor, load_model(run))


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
    test: Dataset, calibrated: Dataset, model: monitoring.Follows, calibration: Calibration, config: AdviseConfig
) -> dict[str, Any]:
    """Return what the calibrated adviser misses and costs on navigations that were made otherwise, and how."""
    theirs, ours = (_leaves(data.manifest["config"]) for data in (test, calibrated))
    found, left_out = follow_all(test, model, config, calibration)
    return {
        "dataset": str(test.folder),
        "differs": {name: value for name, value in theirs.items() if value != ours.get(name)},
        "coverage": monitoring.coverage(found),
        "adviser": measure(found),
        "patients_not_registered": left_out,
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
        axes.plot([0.0, monitoring.periodic_per_minute(0.0)], [100.0, 0.0], color=GREY, label="Periodic imaging")
        curve = [(each["exposures_per_minute"], 100 * each["missed_share"]) for each in content["curves"]["adviser"]]
        label = "Probabilities from which X-ray is due, calibration patients"
        axes.plot(*zip(*curve, strict=True), color=BLUE, marker="o", markersize=3.5, label=label)
        at, label = content["adviser"], f"New patients, X-ray due from {content['calibration'].onset:g}"
        axes.plot(
            at["exposures_per_minute"], 100 * at["missed_share"], "o", color=VERMILLION, markersize=9, label=label
        )
        axes.axhline(5, color=BLACK, lw=0.9, ls=(0, (4, 3)))
        axes.set(xlabel="Exposures a minute (fluoroscopy at 7.5 Hz: 450)", ylabel="Events missed, %")
        axes.set(xlim=(0, 62), ylim=(-1, None))
        axes.legend()
    return figure
