"""`endopilot train`: dataset -> forward and inverse networks; robot's logs -> what they teach beyond the simulator."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Answer, Existing, OutputFolder
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import input_hash, manifest, read_json, write_json
from endopilot.models.config import TrainConfig
from endopilot.robot.learned import figures, learn, left_out, logged
from endopilot.robot.log import read_log
from endopilot.robot.replay import ReplayConfig, prepare, replay_prepared, usable_episodes
from endopilot.runs import claim

LEARNED_FILE = "learned.npz"


def command(
    dataset: Positional[tuple[Existing, ...]] = (),
    /,
    *,
    output: OutputFolder,
    logs: tuple[Existing, ...] = (),
    anatomy: Existing | None = None,
    device: str = "workhorse-014",
    robot: str = "assumed",
    config: TrainConfig = TrainConfig(),
) -> Answer:
    """Train the paper's forward and inverse network on a dataset; or learn from logs what the simulator does not know.

    An interrupted training goes on where it stopped when the same command is given again.

    Args:
        dataset: folders made by `endopilot dataset`, or the folder `episode` that `endopilot navigate` leaves; several,
            of one wire and with episodes of one length, are trained on together.
        output: folder of the run.
        logs: in place of a dataset, CSV files of a robot's commands and tips, or folders of them: by how much a real
            tip is beside the predicted one is learned (docs/concepts/calibration.md), and judged on logs left out.
        anatomy: with logs: folder made by `endopilot anatomy` of what the wire was driven through.
        device: with logs: name of a device (`endopilot devices`) or a YAML file.
        robot: with logs: name of a robot or a YAML file, such as `endopilot calibrate` writes.
    """
    if bool(dataset) == bool(logs):
        raise InputError("dataset: give folders made by `endopilot dataset`, or --logs and --anatomy; one of both")
    if logs:
        if anatomy is None:
            raise InputError("anatomy: logs need the vessel; give --anatomy, a folder made by `endopilot anatomy`")
        return _learn(logs, anatomy, device, robot, output)
    from endopilot.models.train import train  # torch takes seconds to import; --help must not wait for it

    train(dataset, output=output, config=config)
    training = read_json(output / "training.json")
    ends = {name.upper(): {"epochs": len(of["curve"])} | of["curve"][-1] for name, of in training.items()}
    shown = ("epochs", "loss", "validation_loss", "samples_per_second")
    figures = {name: {key: end[key] for key in shown} for name, end in ends.items()}
    return Answer({"run": output, "training": training}, [{"run": output} | figures])


def _learn(logs: tuple[Path, ...], anatomy: Path, device: str, robot: str, output: Path) -> Answer:
    """Learn from logs; write what was learned, and how it does on each log that was left out."""
    files = [file for path in logs for file in (sorted(path.glob("*.csv")) if path.is_dir() else [path])]
    patient, read = read_anatomy(anatomy), [read_log(file) for file in files]
    wire, drives = read_wire(device), read_robot(robot)
    inputs = {name: digest for path in (*files, anatomy) for name, digest in input_hash(path).items()}
    claim(output, "endopilot train --logs", inputs=inputs, device=wire, robot=drives)
    of = prepare(usable_episodes(read, patient), patient, ReplayConfig().given, drives)
    episodes = logged(of, replay_prepared(of, Stack(wire), drives, ReplayConfig()))
    most = len({each.session for each in episodes}) - 1
    taught = {
        count: left_out(episodes, inputs[anatomy.name], sessions=count)
        for count in {1, 2, 4, most}
        if 0 < count <= most
    }
    rows = [{"sessions": count} | figures(episodes, said) for count, said in sorted(taught.items())]
    learn(episodes, inputs[anatomy.name]).write(output / LEARNED_FILE)
    write_json(output / "training.json", {"curve": rows})
    write_json(output / "manifest.json", manifest(config=ReplayConfig(), inputs=inputs, curve=rows))
    said = "gain" if rows and rows[-1]["gain"] else "no gain"
    files_written = {"run": output, "learned": output / LEARNED_FILE, "logs_left_out_say": said}
    return Answer(files_written | {"curve": rows}, [files_written, rows])
