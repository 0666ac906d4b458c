"""`endopilot calibrate` and `endopilot replay`, one after the other, on what a simulated robot logged."""

from __future__ import annotations

import pandas as pd
import pytest
from PIL import Image

from benchmarks.robot.synthetic import PERIOD_S, drawn, logged
from command import run
from endopilot.devices.device import read_wire
from endopilot.devices.robot import read_robot
from endopilot.files import read_json


@pytest.fixture(scope="module")
def log_file(fork, wire, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.csv"
    log = logged(fork, wire, drawn(5), episodes=5, seconds=6.0, seed=5)
    columns = {"time_s": log.time_s, "episode": log.episode}
    names = ("encoder_mm", "encoder_rad", "tip_x_mm", "tip_y_mm", "tip_z_mm")
    columns |= dict(zip(names, [*log.encoders[:, 0].T, *log.tip.T], strict=True))
    table, place = pd.DataFrame(columns), pd.DataFrame(log.command[::2, 0]).groupby(log.episode[::2])
    for k, name in enumerate(("translation_mm_s", "rotation_rad_s")):  # a command stands in every other row
        table.loc[::2, name] = (place[k].diff().fillna(place[k].transform("first")) / PERIOD_S).to_numpy()
    table.to_csv(path, index=False)
    return path


def test_a_robot_is_calibrated_and_its_log_replayed(vessel, log_file, tmp_path, capsys) -> None:
    options = ("--anatomy", vessel, "-o")
    found = run(capsys, "calibrate", log_file, *options, tmp_path / "robot.yaml", "--wires", 4)
    assert {"gain_translation", "play_mm", "latency_s"} <= found["estimates"].keys()
    robot, written = read_robot(tmp_path / "robot.yaml"), read_json(tmp_path / "robot.json")
    assert robot.wire.play_mm == found["estimates"]["play_mm"]["value"] and robot.encoders_at == "motor"
    assert any(line.startswith("play_mm: ") and "95 %" in line for line in robot.sources)
    assert written["estimates"] == found["estimates"] and written["inputs"]["log.csv"]
    for name, each in found["estimates"].items():
        (line,) = (line for line in robot.sources if line.startswith(f"{name}: "))
        assert ("not identifiable" in line) != each["identified"]
    assert found["layer_wire"] == "no gain, left out" and "friction" not in found["estimates"]  # of four wires
    assert read_wire(tmp_path / "robot.device.yaml").friction == read_wire("workhorse-014").friction

    made = tmp_path / "replay"
    files = ("--robot", tmp_path / "robot.yaml", "--device", tmp_path / "robot.device.yaml")
    replayed = run(capsys, "replay", log_file, *options, made, *files)
    assert replayed["episodes"] == 5 and replayed["error_along_mm"] < 0.5
    table, errors = pd.read_csv(made / "replay.csv"), pd.read_csv(made / "errors.csv")
    assert table.groupby("episode")["given"].mean().between(0.4, 0.6).all() and len(errors) == 5
    assert read_json(made / "manifest.json")["figures"] == replayed
    with Image.open(made / "replay.png") as picture:
        assert min(picture.size) > 400
