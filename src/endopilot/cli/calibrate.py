"""`endopilot calibrate`: robot's logs -> the robot as a file, and how sure each of its constants is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Answer, Existing, OutputFile
from endopilot.devices.catheter import write_device
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.files import input_hash, manifest, write_json
from endopilot.robot.calibrate import CalibrateConfig, RobotCalibration, calibrate
from endopilot.robot.log import read_log
from endopilot.robot.replay import summary
from endopilot.runs import check_new

_BY = "endopilot calibrate"


def command(
    logs: Positional[tuple[Existing, ...]],
    /,
    *,
    anatomy: Existing,
    output: OutputFile,
    device: str = "workhorse-014",
    robot: str = "assumed",
    topics: tuple[str, ...] = (),
    overwrite: bool = False,
    config: CalibrateConfig = CalibrateConfig(),
) -> Answer:
    """Find gain, lag, plays, tip shape, friction and stiffness of a robot and its wire, each with an interval.

    What the logs do not tell is said; it is then as in the wire that predicts best, for its constants belong together.
    `navigate`, `ladder` and `replay` take the files.

    Args:
        logs: CSV files of commands and tips, or ROS bags, driven through one vessel with one wire;
            docs/concepts/calibration.md describes them.
        anatomy: folder made by `endopilot anatomy` of what the wire was driven through.
        output: robot.yaml; beside it robot.device.yaml, the wire, and robot.json, all intervals.
        device: name of a device (`endopilot devices`) or a YAML file, as the wire is known.
        robot: name of a robot or a YAML file, as the robot is known.
    """
    for path in (_beside(output), output.with_suffix(".json")):
        check_new(path, (*logs, anatomy), overwrite=overwrite)
    read, patient = [read_log(path, topics=topics) for path in logs], read_anatomy(anatomy)
    found = calibrate(read, patient, read_wire(device), robot=read_robot(robot), config=config)
    names = ", ".join(log.name for log in read)
    _write(found, output, names)
    figures = summary(found.replays)
    known = np.array([each.rotation_known_rad for each in found.replays])
    known_share = float(np.isfinite(known).mean())
    about = {
        "start_rotation_known_in": round(known_share, 3),
        "start_rotation_known_rad": round(float(np.nanmedian(known)), 2) if known_share else None,
        "band_of_90_percent_mm": None if found.band_mm is None else round(found.band_mm, 2),
        "band_of_another_episode_mm": None if found.next_band_mm is None else round(found.next_band_mm, 2),
        "it_holds_in_logs_left_out": None if found.band_share is None else round(found.band_share, 3),
    }
    about |= {f"layer_{name}": said for name, said in found.layers.items()}
    inputs = {name: digest for path in (*logs, anatomy) for name, digest in input_hash(path).items()}
    intervals = {
        name: {
            "value": each.value,
            "interval": [each.low, each.high],
            "identified": each.identified,
            "searched": list(each.searched),
            "unit": each.unit,
        }
        for name, each in found.estimates.items()
    }
    record = {"estimates": intervals} | about | figures
    write_json(output.with_suffix(".json"), manifest(config=config, seed=config.seed, inputs=inputs) | record)
    estimated = {name: str(each) for name, each in found.estimates.items()}
    files = {"robot": output, "wire": _beside(output)}
    read_out = any(np.isfinite(log.encoders).any() for log in read)
    encoders = {"encoders_at": found.robot.encoders_at if read_out else "not identifiable from this log"}
    return Answer(record | files, shown=[estimated | encoders | about | figures | files])


def _write(found: RobotCalibration, output: Path, names: str) -> None:
    by_name = {
        name: f"{each}, 95 %" if each.identified else f"{each.value:.4g}, {each}"
        for name, each in found.estimates.items()
    }
    sources = tuple(f"{name}: {text}, by {_BY} from {names}" for name, text in by_name.items())
    kept = tuple(line for line in found.robot.sources if line.partition(":")[0] not in by_name)
    replace(found.robot, sources=(*kept, *sources)).write(output)
    of_wire = {"tip_bend": ("tip_bend_deg", "tip_bend_length_mm"), "friction": ("friction",)}
    of_wire |= dict.fromkeys(("bend_stiffness_n_mm2", "twist_stiffness_n_mm2"), ("tip_stiffness_factor",))
    texts = {
        field: f"by {_BY} from {names}: " + ", ".join(f"{name} {by_name[name]}" for name in by)
        for field, by in of_wire.items()
        if all(name in by_name for name in by)
    }
    write_device(replace(found.wire, sources=dict(found.wire.sources) | texts), output=_beside(output))


def _beside(output: Path) -> Path:
    return output.with_suffix(".device.yaml")
