"""`endopilot bench SUBJECT`: benchmarks, one function for each subject.

Where figures have bars, the command leaves with exit code 1 if a figure does not meet its bar.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from endopilot.atlas.atlas import AtlasConfig
from endopilot.benchmarks.imaging_cases import Difficulty
from endopilot.benchmarks.published import PublishedConfig
from endopilot.benchmarks.robustness import RobustnessConfig
from endopilot.benchmarks.xray import XrayBenchConfig
from endopilot.cli.arguments import OutputFolder, existing, show, show_rows
from endopilot.errors import InputError
from endopilot.settings import Count, Seed, Within
from endopilot.simulation.config import Preset
from endopilot.simulation.motion import MotionName, motion_named

EXIT_FAILED = 1
AboveZero = Annotated[float, Within(0, 1, above_low=True)]


def simulation(
    *,
    preset: Preset = "default",
    catheter: str | None = None,
    motion: MotionName = "still",
    device: Literal["cpu", "cuda"] = "cpu",
    make_reference: bool = False,
    reference: Path | None = None,
    json: bool = False,
) -> None:
    """Measure the speed of the rod core, and the tip's error at that speed against a converged solution.

    Args:
        preset: settings of the rod core: default, fast or accurate.
        catheter: measure the wire in this catheter (a name or a YAML file), beside the wire alone.
        motion: measure the wire in patients that move (breathing, heartbeat or both), beside the same at rest.
        device: measure the processor (cpu), or up to 100 000 wires on a GPU (cuda) and how closely the two agree.
        make_reference: compute the converged solution anew instead, which takes a quarter of an hour.
        reference: file of the converged solution; the shipped one if not given.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.coaxial import bench_coaxial
    from endopilot.benchmarks.gpu import bench_gpu
    from endopilot.benchmarks.motion import bench_motion
    from endopilot.benchmarks.reference import REFERENCE_FILE
    from endopilot.benchmarks.reference import make_reference as make
    from endopilot.benchmarks.simulation import bench_simulation
    from endopilot.devices.catheter import read_catheter

    moves = motion_named(motion)
    if catheter is not None and moves is not None:
        raise InputError("motion: with a catheter; measure one of the two")
    if catheter is not None:
        coaxial = bench_coaxial(read_catheter(catheter), preset)
        show(coaxial, as_json=json)
        _leave(coaxial["passed"])
        return
    if moves is not None:
        moving = bench_motion(moves, preset)
        show({"motion": motion, **moving}, as_json=json)
        _leave(moving["passed"])
        return
    if device == "cuda":
        rows = bench_gpu(preset)
        show_rows(rows, as_json=json)
        _leave(all(row["passed"] is not False for row in rows))
        return
    path = reference or REFERENCE_FILE
    if make_reference:
        show(make(path), as_json=json)
        return
    measured = bench_simulation(preset, reference=path)
    if measured["speed_over_baseline"] is None:
        print("speed_over_baseline is missing: `make core-baseline` builds what it compares with", file=sys.stderr)
    if json:
        show(measured, as_json=True)
    else:
        _show_simulation(measured)


def scaling(*, json: bool = False) -> None:
    """Measure how the rod core's cost grows with elements and worlds.

    Args:
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.simulation import bench_scaling

    show_rows(bench_scaling(), as_json=json)


def robustness(*, json: bool = False, config: RobustnessConfig = RobustnessConfig()) -> None:
    """Drive every shipped device through many anatomies and beyond their ends, and count failures.

    The anatomies are synthetic, or those given.

    Args:
        json: print the figures as JSON.
        config: which rollouts.
    """
    from endopilot.benchmarks.robustness import measure_robustness

    measured = measure_robustness(config)
    if json:
        show(measured, as_json=True)
    else:
        _show_robustness(measured)
    _leave(all(row["passed"] for row in measured["figures"]))


def published(*, json: bool = False, config: PublishedConfig = PublishedConfig()) -> None:
    """Simulate published bench tests of wires and catheters, and show our figures beside theirs.

    Args:
        json: print the figures as JSON.
        config: how often what the articles do not state is drawn.
    """
    from endopilot.benchmarks.published import bench_published

    show_rows(bench_published(config), as_json=json)


def env(*, json: bool = False) -> None:
    """Measure the steps per second of the learning environments in the reference anatomy, and the tip's error.

    Args:
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.env import bench_env

    show(bench_env(), as_json=json)


def dataset(*, output: OutputFolder = Path("runs/bench-dataset"), share: AboveZero = 0.05, json: bool = False) -> None:
    """Make a share of the paper's set of 100 000 navigations, and extrapolate time and size of all of it.

    Args:
        output: folder of this share; an interrupted run goes on where it stopped.
        share: share of the paper's set, above 0, at most 1.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.dataset import bench_dataset

    show(bench_dataset(output, share=share), as_json=json)


def training(*, folder: Path = Path("runs/bench-training"), json: bool = False) -> None:
    """Compare the speed of training on one core with a plain PyTorch loop over the same model and data.

    Args:
        folder: folder of the patient and of the navigations to train on.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.training import bench_training

    rows = bench_training(folder)
    show_rows(rows, as_json=json)
    _leave(all(row["passed"] for row in rows))


def labels(*, count: Count = 40, seed: Seed = 0, json: bool = False) -> None:
    """Label the sections of synthetic patients of every kind, and compare with the truth.

    Args:
        count: patients of each kind.
        seed: seed of the atlas.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.labels import measure_labels

    rows = measure_labels(count=count, seed=seed)
    show_rows(rows, as_json=json)
    _leave(all(row["passed"] for row in rows))


def anatomy(
    *,
    centerlines: Path | None = None,
    compare: tuple[Path, ...] = (),
    atlas: AtlasConfig = AtlasConfig(count=40),
    json: bool = False,
) -> None:
    """Extract lumens whose centerlines are known, and print each error beside its bar; or compare with the atlas.

    With --compare it measures bends, forks, calibre and ostium of given anatomies beside the atlas instead: median and
    5th to 95th percentile, and the distance of the two distributions in standard deviations (Wasserstein-1).

    Args:
        centerlines: folder with VMTK's rca_cl.vtp and lca_cl.vtp of a real patient; left out if not given.
        compare: anatomies, or folders of anatomies, to compare with the atlas.
        atlas: the patients to compare with; their kind is that of the given anatomies.
        json: print the figures as JSON.
    """
    if compare:
        from endopilot.benchmarks.anatomy_compare import compare_with_atlas

        rows = compare_with_atlas([existing(folder) for folder in compare], atlas)
        show_rows(rows if json else [_compared(row) for row in rows], as_json=json)
        return
    from endopilot.benchmarks.anatomy import bench_anatomy

    rows = bench_anatomy(None if centerlines is None else existing(centerlines))
    show_rows(rows, as_json=json)
    _leave(all(row["passed"] is not False for row in rows))


def _compared(row: dict[str, Any]) -> dict[str, Any]:
    def spread(name: str) -> str:
        middle, low, high = (row[key] for key in (name, f"{name}_p5", f"{name}_p95"))
        return "-" if middle is None else f"{middle:g} [{low:g} to {high:g}], {row[f'{name}_count']}"

    titles = {"given": "given: median [5-95 %], values", "atlas": "atlas: median [5-95 %], values"}
    return (
        {"kind": row["kind"], "quantity": row["quantity"]}
        | {title: spread(name) for name, title in titles.items()}
        | {"distance": row["distance"]}
    )


def ostia(folder: Positional[Path], /, *, json: bool = False) -> None:
    """Find the coronary ostia of real patients' masks without an aorta, and compare with where they are known to be.

    Args:
        folder: masks named after patients, every label a coronary lumen, and ostia.json: for each patient and vessel
            (rca, lca) `near_aorta_mm`, LPS mm.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.ostia import bench_ostia, judged

    rows = bench_ostia(existing(folder))
    figures = judged(rows)
    if json:
        show({"arteries": rows, "figures": figures}, as_json=True)
    else:
        show_rows(rows, as_json=False)
        show_rows(figures, as_json=False)
    _leave(all(figure["passed"] for figure in figures))


def imaging(
    *,
    cases: Count = 50,
    seed: Seed = 0,
    difficulty: Difficulty = "clean",
    folder: Path = Path("runs/bench-imaging"),
    json: bool = False,
) -> None:
    """Segment synthetic CT angiograms from the volume alone, and compare with the truth.

    Args:
        cases: number of CT angiograms.
        seed: seed of the patients and their scans.
        difficulty: clean, or what disturbs the same scans: slices (thick ones), motion, steps (between heart beats),
            grain (of iterative reconstruction), blooming (of calcium), stents, leads (of a pacemaker), veins,
            appendage (of the left atrium), graft (a bypass).
        folder: folder of the results, one for each difficulty; an interrupted run goes on where it stopped.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.imaging import BARS, ImagingBenchConfig, bench_imaging

    measured = bench_imaging(ImagingBenchConfig(cases=cases, seed=seed, difficulty=difficulty, folder=folder))
    if json:
        show(measured, as_json=True)
    else:
        show_rows([{"figure": name} | measured[name] for name in BARS], as_json=False)
        show({name: value for name, value in measured.items() if name not in BARS}, as_json=False)
    _leave(all(measured[name]["met"] for name in BARS))


def cockpit(*, catheter: str | None = None, json: bool = False) -> None:
    """Measure the cockpit in a headless browser without a GPU: time in reserve, latency, frames per second, start.

    Args:
        catheter: around the wire (a name or a YAML file); both are driven at once.
        json: print the figures as JSON.
    """
    from endopilot.benchmarks.cockpit import BARS, bench_cockpit

    measured = bench_cockpit(catheter)
    if json:
        show(measured, as_json=True)
    else:
        rows = [
            {"figure": name, "value": measured[name], "bar": measured["bars"][name], "passed": measured["passed"][name]}
            for name in BARS
        ]
        show_rows(rows, as_json=False)
    _leave(all(measured["passed"].values()))


def xray(*, json: bool = False, config: XrayBenchConfig = XrayBenchConfig()) -> None:
    """Measure how fast X-ray images are made, and how well tips and poses are found in them, in new patients.

    Args:
        json: print the figures as JSON.
        config: patients and images.
    """
    from endopilot.benchmarks.xray import BARS, bench_xray

    measured = bench_xray(config)
    if json:
        show(measured, as_json=True)
    else:
        rows = [
            {"figure": name, "value": measured[name], "bar": measured["bars"][name], "passed": measured["passed"][name]}
            for name in BARS
        ]
        show_rows(rows, as_json=False)
        two = {name: value for name, value in measured.items() if name in measured["one_view"]}
        show_rows(
            [
                {"group": name} | row
                for name, row in ({"two views": two, "one view": measured["one_view"]} | measured["by"]).items()
            ],
            as_json=False,
        )
        show({"false_alarms_share": measured["false_alarms_share"]}, as_json=False)
    _leave(all(measured["passed"].values()))


SUBJECTS: dict[str, Callable[..., None]] = {
    function.__name__: function
    for function in (
        simulation,
        scaling,
        robustness,
        published,
        env,
        dataset,
        training,
        labels,
        anatomy,
        ostia,
        imaging,
        cockpit,
        xray,
    )
}
"""The subjects that can be measured."""


def _leave(passed: bool) -> None:
    if not passed:
        sys.exit(EXIT_FAILED)


def _show_simulation(measured: dict[str, Any]) -> None:
    groups = ("intervals", "by_anatomy", "reference_own_error")
    errors = measured["intervals"]
    show({name: value for name, value in measured.items() if name not in (*groups, *errors)}, as_json=False)
    rows = [
        {"error": name, "all": measured[name], "90 % interval": interval}
        | {anatomy: figures[name] for anatomy, figures in measured["by_anatomy"].items()}
        | {"reference's own": measured["reference_own_error"][name]}
        for name, interval in errors.items()
    ]
    show_rows(rows, as_json=False)


def _show_robustness(measured: dict[str, Any]) -> None:
    groups = ("by_device", "by_manoeuvre", "by_anatomy")
    show_rows(measured["figures"], as_json=False)
    show_rows([{"group": name} | row for group in groups for name, row in measured[group].items()], as_json=False)
    rest = {name: value for name, value in measured.items() if name not in ("figures", *groups) and value}
    show(rest, as_json=False)
