"""`endopilot dataset`, `dataset-info`, `train` and `evaluate`: random navigations, and networks on them."""

from __future__ import annotations

from pathlib import Path

from endopilot.cli.arguments import Answer, Figures
from endopilot.dataset.config import DatasetConfig
from endopilot.devices.robot import read_robot
from endopilot.devices.stack import Stack
from endopilot.evaluation.evaluate import EvaluateConfig, evaluate
from endopilot.evaluation.results import FIGURES_FOLDER, METRICS_FILE, REPORT_FILE, RESULTS_FILE
from endopilot.files import read_json
from endopilot.models.config import TrainConfig
from endopilot.report.report_text import mean_errors
from endopilot.runs import Existing, OutputFolder, claim
from endopilot.simulation.world import NOMINAL, read_world


def dataset_command(
    anatomies: tuple[Existing, ...],
    /,
    *,
    output: OutputFolder,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    robot: str | None = None,
    world: str = NOMINAL,
    scheduler: str | None = None,
    config: DatasetConfig = DatasetConfig(),
) -> Figures:
    """Simulate random navigations of many patients and store them as a LeRobot v3 dataset.

    Each catheter is driven at random and independently. An interrupted run goes on where it stopped when the same
    command is given again.

    Args:
        anatomies: folders made by `endopilot anatomy` or `endopilot atlas`.
        output: folder of the dataset.
        robot: name of a robot (docs/concepts/robot.md) or a YAML file that makes the motions, and measures them; if not
            given, they are made as drawn.
        world: name of the world that reality is (docs/concepts/worlds.md), or a YAML file.
    """
    from endopilot.dataset.generate import generate_dataset  # an extra brings its libraries; --help needs none

    generate_dataset(
        anatomies,
        output=output,
        device=Stack.of(device, *catheter),
        config=config,
        robot=None if robot is None else read_robot(robot),
        world=read_world(world),
        scheduler=scheduler,
    )
    info = read_json(output / "meta" / "info.json")
    return {"dataset": output, "episodes": info["total_episodes"], "samples": info["total_frames"]}


def dataset_info_command(dataset: Existing, /, *, output: OutputFolder | None = None) -> Figures:
    """Describe a dataset: distributions of depth, offset and force, branches, failures with their reasons.

    Args:
        dataset: folder made by `endopilot dataset`.
        output: folder of the pictures, one of each distribution; none is drawn if not given.
    """
    from endopilot.dataset.info import describe_dataset, draw_pictures  # an extra brings their libraries

    description = describe_dataset(dataset)
    if output is not None:
        claim(output, "endopilot dataset-info", figures=description.figures)
    pictures = [] if output is None else draw_pictures(description, output)
    return description.figures | ({"pictures": pictures} if pictures else {})


def train_command(
    dataset: tuple[Existing, ...], /, *, output: OutputFolder, config: TrainConfig = TrainConfig()
) -> Answer:
    """Train the paper's forward and inverse network on a dataset.

    An interrupted training goes on where it stopped when the same command is given again.

    Args:
        dataset: folders made by `endopilot dataset`, or the folder `episode` that `endopilot navigate` leaves; several,
            of one wire and with episodes of one length, are trained on together.
        output: folder of the run.
    """
    from endopilot.models.train import train  # torch takes seconds to import; --help must not wait for it

    train(dataset, output=output, config=config)
    training = read_json(output / "training.json")
    ends = {name.upper(): {"epochs": len(of["curve"])} | of["curve"][-1] for name, of in training.items()}
    shown = ("epochs", "loss", "validation_loss", "samples_per_second")
    figures = {name: {key: end[key] for key in shown} for name, end in ends.items()}
    return Answer({"run": output, "training": training}, [{"run": output} | figures])


def evaluate_command(
    run: Path,
    /,
    *,
    output: OutputFolder,
    dataset: Existing | None = None,
    other_seeds: tuple[Path, ...] = (),
    config: EvaluateConfig = EvaluateConfig(),
) -> Answer:
    """Roll the networks of a run out in open loop (protocols P1 to P4) and measure their errors.

    Args:
        run: folder made by `endopilot train`, or `wires`, the simulated wires.
        output: folder of report.html, metrics.json, figures and tables.
        dataset: dataset to evaluate on; the one that the run was trained on if not given.
        other_seeds: runs of the same training with other seeds; their errors in P1 are reported beside the run's, with
            mean and standard deviation.
    """
    from endopilot.report.report import report_evaluation  # matplotlib and plotly are slow to import

    metrics = evaluate(run, output=output, config=config, dataset=dataset, other_seeds=other_seeds)
    report_evaluation(output)
    shown: list[Figures | str] = []
    for split, record in metrics["splits"].items():
        counts = f"{record['episodes']} navigations, patients: {len(record['anatomies'])}"
        shown.append(f"{record['title']} ({split}; {counts}): mean absolute error, mm, by s after the given states")
        shown.append(mean_errors(metrics, split))
    names = {"report": REPORT_FILE, "figures": FIGURES_FOLDER, "metrics": METRICS_FILE, "predictions": RESULTS_FILE}
    files = {name: output / file for name, file in names.items()}
    return Answer(metrics, [*shown, {"findings": metrics["findings"], **files}])
