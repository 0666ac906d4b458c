"""`endopilot replay` and `calibrate`: what a real robot logged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Answer, Figures
from endopilot.devices.catheter import write_device
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.devices.stack import Stack
from endopilot.files import input_hash, manifest, write_json, write_whole
from endopilot.plotting import png
from endopilot.robot.calibrate import CalibrateConfig, RobotCalibration, calibrate
from endopilot.robot.log import read_log
from endopilot.robot.replay import EpisodeReplay, ReplayConfig, replay_log, summary
from endopilot.runs import Existing, OutputFolder, Place, claim


def replay_command(
    log: Existing,
    /,
    *,
    anatomy: Existing,
    output: OutputFolder,
    device: str = "workhorse-014",
    robot: str = "assumed",
    topics: tuple[str, ...] = (),
    config: ReplayConfig = ReplayConfig(),
) -> Figures:
    """Simulate a log's commands, and compare the simulated tip with the one that was seen.

    The first part of each episode says how deep the wire lies and to which side it is turned; the rest is predicted.

    Args:
        log: CSV file of commands and tips, or a ROS bag; docs/concepts/calibration.md describes them.
        anatomy: folder made by `endopilot anatomy` of what the wire was driven through.
        output: folder of replay.png, replay.csv (both tips at each time), errors.csv (each episode's) and
            manifest.json.
        robot: name of a robot or a YAML file, such as `endopilot calibrate` writes.
    """
    from endopilot.report.figures import replay_figure  # matplotlib is slow to import

    patient, read = read_anatomy(anatomy), read_log(log, topics=topics)
    wire, drives = read_wire(device), read_robot(robot)
    inputs = input_hash(log) | input_hash(anatomy)
    claim(output, "endopilot replay", inputs=inputs, device=wire, robot=drives, config=config)
    found = replay_log([read], patient, Stack(wire), robot=drives, config=config)
    figures = summary(found)
    title = f"{read.name} beside {device}, robot {Path(robot).name}"
    write_whole(output / "replay.png", png(replay_figure(patient, found, title)))
    write_whole(output / "replay.csv", pd.concat([_table(each) for each in found]).to_csv(index=False))
    rows = [{"episode": each.number, **{f"{k}_mm": v for k, v in each.errors.items()}} for each in found]
    write_whole(output / "errors.csv", pd.DataFrame(rows).to_csv(index=False))
    write_json(output / "manifest.json", manifest(config=config, inputs=inputs, figures=figures))
    return figures


def _table(episode: EpisodeReplay) -> pd.DataFrame:
    columns = {"episode": np.full(len(episode.time_s), episode.number), "time_s": episode.time_s}
    columns |= {"given": episode.given.astype(int)}
    for name, tip, k in (("seen", episode.seen, 0), ("simulated", episode.simulated, 1)):
        columns |= {f"{name}_{axis}_mm": tip[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"{name}_abscissa_mm": episode.abscissa[:, k], f"{name}_branch": episode.branch[:, k].astype(int)}
    columns |= {f"predicted_{axis}_mm": episode.predicted[:, i] for i, axis in enumerate("xyz")}
    return pd.DataFrame(columns)


_BY, _WIRE = "endopilot calibrate", ".device.yaml"


def calibrate_command(
    logs: tuple[Existing, ...],
    /,
    *,
    anatomy: Existing,
    output: Annotated[Path, Place("file", beside=(_WIRE, ".json"))],
    device: str = "workhorse-014",
    robot: str = "assumed",
    topics: tuple[str, ...] = (),
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
    files = {"robot": output, "wire": output.with_suffix(_WIRE)}
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
    write_device(replace(found.wire, sources=dict(found.wire.sources) | texts), output=output.with_suffix(_WIRE))
