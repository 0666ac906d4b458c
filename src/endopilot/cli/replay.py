"""`endopilot replay`: a robot's log -> its commands in the simulator, and both tips side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from tyro.conf import Positional

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.devices.stack import Stack
from endopilot.files import input_hash, manifest, write_json, writing
from endopilot.plotting import png
from endopilot.robot.log import read_log
from endopilot.robot.replay import EpisodeReplay, ReplayConfig, replay_log, summary
from endopilot.runs import claim


def command(
    log: Positional[Existing],
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
    from endopilot.report.replay_figure import replay_figure  # matplotlib is slow to import

    patient, read = read_anatomy(anatomy), read_log(log, topics=topics)
    wire, drives = read_wire(device), read_robot(robot)
    inputs = input_hash(log) | input_hash(anatomy)
    claim(output, "endopilot replay", inputs=inputs, device=wire, robot=drives, config=config, version=__version__)
    found = replay_log([read], patient, Stack(wire), robot=drives, config=config)
    figures = summary(found)
    title = f"{read.name} beside {device}, robot {Path(robot).name}"
    with writing(output / "replay.png") as partial:
        partial.write_bytes(png(replay_figure(patient, found, title)))
    with writing(output / "replay.csv") as partial:
        pd.concat([_table(each) for each in found]).to_csv(partial, index=False)
    with writing(output / "errors.csv") as partial:
        rows = [{"episode": each.number, **{f"{k}_mm": v for k, v in each.errors.items()}} for each in found]
        pd.DataFrame(rows).to_csv(partial, index=False)
    write_json(output / "manifest.json", manifest(config=config, inputs=inputs, figures=figures))
    return figures


def _table(episode: EpisodeReplay) -> pd.DataFrame:
    columns = {"episode": np.full(len(episode.time_s), episode.number), "time_s": episode.time_s}
    columns |= {"given": episode.given.astype(int)}
    for name, tip, k in (("seen", episode.seen, 0), ("simulated", episode.simulated, 1)):
        columns |= {f"{name}_{axis}_mm": tip[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"{name}_abscissa_mm": episode.abscissa[:, k], f"{name}_branch": episode.branch[:, k].astype(int)}
    return pd.DataFrame(columns)
