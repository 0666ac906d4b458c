"""All stages in a row: a CT angiogram goes in, a report comes out. `run_demo` makes its own patients first;
`run_volume` takes one volume of yours, with a target if given. Both record the finished stages, so that an interrupted
run goes on, and end with report.html, metrics.json and manifest.json."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from endopilot.anatomy.extract import AnatomyConfig, extract_anatomy
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.control.navigate import NavigateConfig
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.loader import read_dataset
from endopilot.devices.device import Wire, read_wire
from endopilot.evaluation.anatomy_score import score_anatomy
from endopilot.evaluation.results import REPORT_FILE
from endopilot.extras import require_extras
from endopilot.files import input_hash, manifest, read_json, write_json
from endopilot.imaging.segment import METHODS, SegmentConfig, segment
from endopilot.imaging.volume import read_mask, read_volume, write_mask, write_volume
from endopilot.models.config import WIRES, TrainConfig
from endopilot.parallel import each
from endopilot.phantom.phantom import PhantomConfig, make_phantom
from endopilot.pipeline.navigation import navigate_into
from endopilot.progress import progress
from endopilot.runs import Existing, OutputFolder, claim
from endopilot.settings import Seconds, Seed, Within, settings
from endopilot.simulation.trajectory import Trajectory
from endopilot.vessels.sources import read_source

VOLUME_SUFFIX = ".nii.gz"
STAGES_FILE, _KEPT = "stages.json", ("finished", "seconds", "rejected")
EVALUATED = 16  # navigations evaluated in each split; each takes some 13 s of a core
MISMATCH = (0.8, 1.2)  # friction and tip stiffness of the navigations over those that simulated wires are given
_EXTRAS = ("learn", "report")  # extras that the stages need, the last one after minutes of work
DEMO_ORIGIN = (
    "The patients are synthetic: right coronary arteries drawn from published statistics, and a CT angiogram of each, "
    "made with noise, blur, calcium, chambers and veins. Everything after the CT is made from it alone."
)
UNKNOWN_WIRE = (
    "The model is not given the wires as they are: friction and tip stiffness differ by up to 20 % from what it is "
    "given."
)
RUN_ORIGIN = "One CT angiogram, given by the user; everything is made from it alone."


@settings
class StudyConfig:
    """What is simulated and trained on the patients' volumes."""

    device: str = "workhorse-014"
    """Name of a shipped device (`endopilot devices`) or a YAML file."""
    sequences: Annotated[int, Within(1, 100000)] = 40
    """Random navigations simulated in each patient."""
    seconds: Seconds = 60.0
    """Length of a navigation, s."""
    training_seconds: Annotated[float, Within(0, 10 * 86400)] = 0.0
    """Training time of each of the paper's two networks, s; 0 evaluates the simulated wires."""
    seed: Seed = 1
    """Seed of everything random."""


@settings
class DemoConfig(StudyConfig):
    """The demo: synthetic right-coronary patients."""

    patients: Annotated[int, Within(3, 1000)] = 6
    """Number of patients, at least 3."""


@settings
class RunConfig(StudyConfig):
    """One patient's volume."""

    segmentation: SegmentConfig = field(default_factory=SegmentConfig)
    """How to segment."""


@dataclass(kw_only=True)
class Study:
    """A run in its folder: settings and the wire, the input's SHA-256s and notes, for the report where the patients
    come from and what was typed; and, as `stages.json` keeps them, finished stages, their seconds, rejected
    patients."""

    output: Path
    config: StudyConfig
    segmentation: SegmentConfig
    device: Wire
    origin: str
    command: str
    inputs: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    navigation: Path | None = None
    finished: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    rejected: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Read what an interrupted run has left."""
        if (self.output / STAGES_FILE).exists():
            left = read_json(self.output / STAGES_FILE, keys=_KEPT)
            self.finished, self.seconds, self.rejected = (left[name] for name in _KEPT)

    @property
    def trains(self) -> bool:
        """Whether networks are trained here, rather than simulated wires evaluated."""
        return self.config.training_seconds > 0

    def do(self, name: str, work: Callable[[], None]) -> None:
        """Do the work of a stage unless it is finished; time spent before an interruption counts too."""
        if name in self.finished:
            return
        start = time.perf_counter()
        try:
            work()
            self.finished.append(name)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            write_json(self.output / STAGES_FILE, {name: getattr(self, name) for name in _KEPT})

    def do_each(self, name: str, title: str, items: Sequence[Path], work: Callable[[Path], None]) -> None:
        """Do a stage's work for every item. A bad item is rejected and recorded; a bad only item ends the run."""

        def work_on_all() -> None:
            bad = each(title, items, work)
            if len(items) == 1 and bad:
                raise bad[items[0]]
            self.rejected.update({item.name: str(error) for item, error in bad.items()})

        self.do(name, work_on_all)


def run_demo(*, output: OutputFolder = Path("runs/demo"), config: DemoConfig = DemoConfig()) -> dict[str, Any]:
    """Run every stage once on synthetic patients: CT angiogram, segmentation, anatomy, simulation, training, report.

    An interrupted demo goes on where it stopped when the same command is given again.

    Args:
        output: folder of all results; the report is report.html.

    Returns:
        The report's path, and figures.

    Raises:
        InputError: A stage's library is missing, the folder is another run's, or too few patients were segmented.
    """
    require_extras(*_EXTRAS)
    device = read_wire(config.device)
    claim(output, "endopilot demo", config=config, device=device)
    run = Study(
        output=output,
        config=config,
        segmentation=SegmentConfig(method="coronary", vessel="rca"),
        device=device,
        origin=DEMO_ORIGIN,
        command="endopilot demo",
        navigation=output / "navigation",
    )
    atlas = AtlasConfig(vessel="rca", count=config.patients, seed=config.seed)
    truths = [output / "truth" / f"patient-{index + 1}" for index in range(config.patients)]
    volumes = [output / "ct" / f"{folder.name}{VOLUME_SUFFIX}" for folder in truths]
    run.do_each("atlas", "Synthetic patients", truths, partial(_make_patient, config=atlas))
    run.do_each("phantom", "Synthetic CT angiograms", volumes, partial(_make_volume, config=atlas))
    anatomies = _anatomies(run, volumes)

    def drive() -> None:
        tree = read_anatomy(anatomies[0]).tree
        target = tree.section_names[tree.branches[tree.longest_leaf()].section[-1]]
        _navigate(run, anatomies[0], target)

    run.do("navigation", drive)
    return _study(run, anatomies)


def run_volume(
    volume: Existing,
    /,
    *,
    output: OutputFolder,
    target: str | None = None,
    series: str | None = None,
    phase: str | None = None,
    config: RunConfig = RunConfig(),
) -> dict[str, Any]:
    """Run every stage on one patient, from the CT angiogram to the report.

    With --target the agent drives the wire to a place of the vessel, as `endopilot navigate` does with its defaults;
    the page of that navigation is in the folder `navigation`. Simulated wires are evaluated in this
    patient; --training-seconds trains networks on it instead.

    An interrupted run goes on where it stopped when the same command is given again.

    Args:
        output: folder of all results; the report is report.html.

    Raises:
        InputError: As `run_demo`, `read_volume`, `segment` and `navigate`.
    """
    require_extras(*_EXTRAS)
    content, device = read_volume(volume, series=series, phase=phase), read_wire(config.device)
    inputs = input_hash(volume, content.files)
    identity = {"volume_sha256": inputs[volume.name], "method": METHODS.origin(config.segmentation.method)}
    claim(output, "endopilot run", **identity, config=config, device=device)
    copy = output / "ct" / f"patient{VOLUME_SUFFIX}"
    folder = None if target is None else output / "navigation" / re.sub(r"[^\w.,+-]", "_", target)
    options = "".join(f" --{name} {value}" for name, value in (("series", series), ("phase", phase)) if value)
    run = Study(
        output=output,
        config=config,
        segmentation=config.segmentation,
        device=device,
        origin=RUN_ORIGIN,
        command=f"endopilot run {volume} -o {output}" + options,
        inputs=inputs,
        notes=content.notes,
        navigation=folder,
    )
    run.do("read", lambda: write_volume(content, copy))
    for note in run.notes:
        print(note, file=sys.stderr)
    del content  # up to a gigabyte
    anatomies = _anatomies(run, [copy])
    navigation = {} if target is None else _navigate(run, anatomies[0], target)
    return {name: navigation[name] for name in ("outcome", "page") if name in navigation} | _study(run, anatomies)


def _number(path: Path) -> int:
    """Return a synthetic patient's number, from 0 on, by the name of its folder or volume."""
    return int(path.name.removesuffix(VOLUME_SUFFIX).rpartition("-")[2]) - 1


def _make_patient(folder: Path, *, config: AtlasConfig) -> None:
    if not folder.exists():
        write_anatomy(make_patient(config, _number(folder)), output=folder)


def _make_volume(volume: Path, *, config: AtlasConfig) -> None:
    if not volume.exists():
        seed, truth = config.seed * config.count + _number(volume), _beside(volume, "truth")
        write_volume(make_phantom(read_anatomy(truth), config=PhantomConfig(), seed=seed), volume)


def _make_mask(volume: Path, *, config: SegmentConfig, notes: tuple[str, ...]) -> None:
    path = _beside(volume, "masks", VOLUME_SUFFIX)
    if not path.exists():
        mask = segment(replace(read_volume(volume), notes=notes), config=config)
        write_mask(mask, path, manifest=manifest(config=config, inputs=input_hash(volume)))


def _make_anatomy(volume: Path, *, config: AnatomyConfig) -> None:
    mask, folder = _beside(volume, "masks", VOLUME_SUFFIX), _beside(volume, "anatomies")
    if mask.exists() and not folder.exists():
        write_anatomy(extract_anatomy(read_source(mask), name=folder.name, config=config), output=folder)


def _beside(volume: Path, folder: str, suffix: str = "") -> Path:
    """Return where else a study keeps what belongs to a patient's volume or anatomy."""
    return volume.parents[1] / folder / f"{volume.name.removesuffix(VOLUME_SUFFIX)}{suffix}"


def _anatomies(run: Study, volumes: Sequence[Path]) -> list[Path]:
    """Segment volumes, extract their anatomies, and return the folders of those where both succeeded."""
    scheme = run.segmentation.vessel if run.segmentation.method == "coronary" else "generic"
    make_mask = partial(_make_mask, config=run.segmentation, notes=run.notes)
    make_anatomy = partial(_make_anatomy, config=AnatomyConfig(vessel=scheme))
    run.do_each("segmentation", "Segmentation", volumes, make_mask)
    run.do_each("anatomy", "Centerlines and distance maps", volumes, make_anatomy)
    return [folder for folder in (_beside(volume, "anatomies") for volume in volumes) if folder.exists()]


def _navigate(run: Study, anatomy: Path, target: str) -> dict[str, Any]:
    assert run.navigation is not None
    settings = NavigateConfig(seed=run.config.seed)
    return navigate_into(anatomy, target=target, output=run.navigation, device=run.config.device, config=settings)


def _study(run: Study, anatomies: Sequence[Path]) -> dict[str, Any]:
    """Simulate navigations, train networks on them or take simulated wires, evaluate the model, and report."""
    from endopilot.dataset.generate import generate_dataset  # an extra brings its libraries
    from endopilot.evaluation.evaluate import EvaluateConfig, evaluate
    from endopilot.models.train import train  # torch takes seconds to import
    from endopilot.report.report import report_evaluation

    output, config, trains = run.output, run.config, run.trains
    tested = len(anatomies) // 3 if trains else len(anatomies) - len(anatomies) // 3  # one at least is of another split
    shares = (1 - tested / len(anatomies), 0.0, tested / len(anatomies)) if tested else None
    friction = (MISMATCH[0] * run.device.friction, MISMATCH[1] * run.device.friction)
    dataset = DatasetConfig(
        sequences=config.sequences,
        seconds=config.seconds,
        seed=config.seed,
        friction=None if trains else friction,
        tip_stiffness_factor=None if trains else MISMATCH,
        anatomy_shares=shares,
        seen_test_share=DatasetConfig.seen_test_share if trains else 0.0,  # all are new to simulated wires
    )
    run.do("dataset", lambda: generate_dataset(anatomies, output=output / "dataset", device=run.device, config=dataset))
    if trains:
        training = TrainConfig(max_seconds=config.training_seconds, seed=config.seed)
        run.do("training", lambda: train(output / "dataset", output=output / "training", config=training))

    model = output / "training" if trains else Path(WIRES)

    def measure() -> None:
        settings = EvaluateConfig(sequences=EVALUATED, seed=config.seed)
        evaluate(model, output=output / "evaluation", config=settings, dataset=output / "dataset")
        report_evaluation(output / "evaluation")

    run.do("evaluation", measure)
    run.do("report", lambda: _report(run, anatomies))
    return _finish(run)


def _report(run: Study, anatomies: Sequence[Path]) -> None:
    from endopilot.report.report import PatientContent, write_report  # matplotlib and plotly

    output = run.output
    replay, scores = _replay(output), _scores(anatomies)
    write_json(output / "scores.json", scores)
    patients = tuple(
        PatientContent(
            name=folder.name,
            anatomy=folder,
            volume=_beside(folder, "ct", VOLUME_SUFFIX),
            mask=_beside(folder, "masks", VOLUME_SUFFIX),
            scores=scores.get(folder.name, {}),
        )
        for folder in anatomies
    )
    write_report(
        output / REPORT_FILE,
        title="endopilot: from a CT angiogram to guidewire control",
        origin=f"{run.origin} {UNKNOWN_WIRE}" if not run.trains else run.origin,
        command=run.command,
        patients=patients,
        evaluation=output / "evaluation",
        replay=replay,
        navigation=run.navigation,
        stage_seconds=run.seconds,
        manifest=manifest(config=run.config, seed=run.config.seed, inputs=run.inputs, rejected=run.rejected),
    )


def _scores(anatomies: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Return the scores of those anatomies whose truth is known."""
    scores, known = {}, [folder for folder in anatomies if _beside(folder, "truth").exists()]
    with progress("Comparing with the truth", len(known)) as advance:
        for folder in known:
            mask, truth = read_mask(_beside(folder, "masks", VOLUME_SUFFIX)), read_anatomy(_beside(folder, "truth"))
            scores[folder.name] = asdict(score_anatomy(mask, read_anatomy(folder), truth))
            advance()
    return scores


def _replay(output: Path) -> tuple[Path, Trajectory]:
    """Simulate one test navigation again with the wire's shape, that in which the tip travelled farthest."""
    dataset = read_dataset(output / "dataset")
    held_out = dataset.of_split("test" if "test" in dataset.split else "seen_test")
    best = int(np.ptp(held_out.tip_abscissa[:, :, 0], axis=1).argmax())
    folder = dataset.anatomy_folder(str(held_out.anatomy[best]))
    return folder, held_out.trajectory(best, record_shape=True)


def _finish(run: Study) -> dict[str, Any]:
    output, wall_seconds = run.output, sum(run.seconds.values())
    metrics = read_json(output / "evaluation" / "metrics.json")
    if not (output / "manifest.json").exists():
        write_json(output / "metrics.json", {**metrics, "anatomy_scores": read_json(output / "scores.json")})
        facts = {"wall_seconds": wall_seconds, "stages": run.seconds, "rejected": run.rejected}
        record = manifest(config=run.config, seed=run.config.seed, inputs=run.inputs, **facts, notes=run.notes)
        write_json(output / "manifest.json", record)
    return {
        "report": str(output / REPORT_FILE),
        "wall_seconds": round(wall_seconds, 1),
        "rejected": run.rejected,
        **({"notes": list(run.notes)} if run.notes else {}),
        "findings": metrics["findings"],
    }
