"""`endopilot navigate` on a small synthetic patient: its folder, what can be done with it, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from command import refused, run
from endopilot.anatomy.io import read_anatomy
from endopilot.cli import command_of
from endopilot.control.navigate import NavigateConfig, navigate
from endopilot.control.outcome import tell_outcome
from endopilot.dataset.loader import read_dataset
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.files import read_json
from endopilot.navigation.policy import Decision, Observation
from endopilot.pipeline import navigation
from endopilot.report.navigation_page import navigation_figure
from endopilot.simulation.trajectory import read_trajectory
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation

SHORT = ("--tip", "own", "--seconds", "20")
FILES = ["episode", "manifest.json", "navigation.csv", "navigation.html", "navigation.png", "run.json",
         "trajectory.npz"]  # fmt: skip


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """Return the folder of a synthetic patient."""
    folder = tmp_path_factory.mktemp("atlas")
    made = command_of("atlas").run(["-o", str(folder), "--vessel", "rca", "--count", "1", "--seed", "41"], shown=False)
    return folder / made[0]["patient"]


@pytest.fixture(scope="module")
def driven(patient, tmp_path_factory):
    """Return the folder of a navigation under model mismatch, and its figures."""
    folder = tmp_path_factory.mktemp("driven") / "navigation"
    robot = folder.with_name("robot.yaml")
    robot.write_text("latency_s: 0.1\njitter_s: 0.02\n", encoding="utf-8")
    world = folder.with_name("world.yaml")
    world.write_text("friction_factor: 1.2\ntip_stiffness_factor: 0.8\nostium_mm: 0.4\n", encoding="utf-8")
    config = NavigateConfig(
        tip="own",
        seconds=20.0,
        seed=3,
        world=str(world),
        robot=str(robot),
    )
    return folder, navigation.navigate_into(patient, target="2", output=folder, config=config)


def test_the_folder_tells_what_happened(driven, patient):
    folder, figures = driven
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert figures["reached"] and figures["outcome"].startswith("reached section 2 at ")
    table, record = pd.read_csv(folder / "navigation.csv"), read_json(folder / "manifest.json")
    assert table["time_s"].tolist() == (0.5 * np.arange(len(table))).tolist()
    assert table["xray"].sum() == figures["exposures"] and table["xray"].iloc[0] == 1
    assert table["contact_force_n"].max() == pytest.approx(figures["peak_force_n"], abs=1e-4)
    assert abs(table["tip_abscissa_mm"].iloc[-1] - figures["target_mm"]) <= 2.0
    assert str(table["section"].iloc[-1]) == "2"
    assert table["measured_tip_abscissa_mm"].notna().tolist() == (table["xray"] == 1).tolist()
    assert table["band_tip_abscissa_mm"].notna().sum() > len(table) / 2
    # every exposure but the first was asked for a decision before, with a reason; the last decision's comes too late
    asked = (table["asks_for_xray"].fillna("") != "").to_numpy()
    np.testing.assert_array_equal(asked[1:-2], (table["xray"] == 1).to_numpy()[2:-1])
    differs = {"tip_stiffness_factor": 0.8, "friction_factor": 1.2, "ostium_mm": 0.4}
    assert record["world"] == differs | {"name": str(folder.with_name("world.yaml"))}
    assert read_trajectory(folder / "trajectory.npz").about["world"] == record["world"]
    assert record["robot"]["latency_s"] == 0.1 and record["robot"]["encoders_at"] == "wire"
    assert record["anatomy"]["identity"] == read_anatomy(patient).identity
    # it starts deeper than the encoder says
    assert table["inserted_length_mm"].iloc[0] == pytest.approx(2.4, abs=1e-6)


def test_the_page_needs_nothing_beside_it(driven):
    folder, figures = driven
    page = (folder / "navigation.html").read_text(encoding="utf-8")
    for part in (
        "Plotly.newPlot",
        "data:image/png;base64,",
        "Wires held possible",
        "Tip under X-ray",
        "endopilot simulate",
    ):
        assert part in page
    assert figures["outcome"][1:] in page
    outside = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert len(outside) < len(page) / 2 and not re.search(r"""(src|href)=["']?http""", outside)


def test_the_trajectory_holds_what_was_decided(driven):
    folder, figures = driven
    recorded, table = read_trajectory(folder / "trajectory.npz"), pd.read_csv(folder / "navigation.csv")
    assert len(recorded.about["exposures_s"]) == figures["exposures"]
    assert recorded.about["exposures_s"] == table["time_s"][table["xray"] == 1].tolist()
    assert recorded.about["reason"] == "reached" and recorded.about["policy"] == "agent"
    assert recorded.about["target"]["abscissa"] == pytest.approx(figures["target_mm"], abs=0.01)
    assert recorded.about["asks_for_xray"] == table["asks_for_xray"].fillna("").tolist()[:-1]
    for name, column in (
        ("decided", ["translation_mm_s", "rotation_rad_s"]),
        ("measured", ["measured_tip_abscissa_mm", "measured_tip_offset_mm"]),
        ("believed", ["believed_tip_abscissa_mm", "believed_tip_offset_mm"]),
        ("half_width", ["band_tip_abscissa_mm", "band_tip_offset_mm"]),
    ):
        values = recorded.columns[name].reshape(len(table) - 1, 10, 2)
        np.testing.assert_array_equal(values[:, 0], table[column].to_numpy()[:-1], err_msg=name)
        np.testing.assert_array_equal(values[:, 9], values[:, 0])


def test_a_guiding_catheter_that_leans_is_seen_and_written(patient, capsys, tmp_path):
    folder = tmp_path / "leans"
    drives = ("--policy", "forward", "--world", "leaning-catheter", "--seed", "3", *SHORT)
    run(capsys, "navigate", patient, "--target", "1", "-o", folder, *drives)
    assert sorted(path.name for path in folder.iterdir()) == ["anatomy", *FILES]
    record, page = read_json(folder / "manifest.json"), (folder / "navigation.html").read_text(encoding="utf-8")
    given, real = (read_anatomy(each).insertion.direction for each in (patient, folder / "anatomy"))
    seen, unseen_deg = np.array(record["catheter_axis"]), record["world"]["axis_deg"]
    off_deg = np.degrees(np.arccos([given @ real, seen @ real]))
    assert off_deg == pytest.approx([15.0, unseen_deg], abs=1e-3) and 0.0 < unseen_deg < 2.0
    assert f"15° off its given axis; X-ray shows it to {unseen_deg:.1f}°" in page
    again = ("--controls", folder / "trajectory.npz", "-o", tmp_path / "again.csv")
    run(capsys, "simulate", folder / "anatomy", *again)
    assert "of another vessel" in refused(capsys, "simulate", patient, *again, "--overwrite")
    table, wire = pd.read_csv(folder / "navigation.csv"), pd.read_csv(tmp_path / "again.csv")
    np.testing.assert_allclose(wire["tip_z_mm"].to_numpy()[9::10], table["tip_z_mm"].to_numpy()[1:], atol=1e-9)


def test_a_catheter_follows_its_wire_and_both_are_written(patient, capsys, tmp_path):
    folder = tmp_path / "coaxial"
    World(friction_factor=1.1).write(tmp_path / "rough.yaml")
    command = ("navigate", patient, "--target", "1", "--policy", "in-turn", "--arrives", "catheter", *SHORT)
    figures = run(
        capsys, *command, "--world", tmp_path / "rough.yaml", "--catheter", "microcatheter-1.7f", "-o", folder
    )
    assert figures["reached"]
    assert sorted(path.name for path in folder.iterdir()) == FILES
    table = pd.read_csv(folder / "navigation.csv")
    assert table["catheter_1_inserted_length_mm"].iloc[-1] > 0.8 * figures["target_mm"]
    assert abs(table["catheter_1_tip_abscissa_mm"].iloc[-1] - figures["target_mm"]) <= 2.0
    given, episode = read_catheter("microcatheter-1.7f"), read_dataset(folder / "episode")
    lengths = episode.inserted_length[0, : len(table) - 1, 1]
    np.testing.assert_allclose(lengths, table["catheter_1_inserted_length_mm"][1:], atol=1e-4)
    true = read_trajectory(folder / "trajectory.npz").set_up
    assert true.stacks[0].catheters == (replace(given, friction=1.1 * given.friction),)
    np.testing.assert_array_equal(episode.friction, true.friction)
    wire = read_wire("workhorse-014")
    assert true.friction[0].tolist() == [1.1 * wire.friction, 1.1 * given.friction]
    assert episode.stack.catheters == (given,) and episode.initial[0, 1].tolist() == [0.0, 0.0]
    again = run(capsys, "simulate", patient, "--controls", folder / "trajectory.npz", "-o", tmp_path / "again.csv")
    assert again["valid_worlds"] == 1
    motion = pd.read_csv(tmp_path / "again.csv")
    for name in ("tip_z_mm", "inserted_length_mm", "catheter_1_inserted_length_mm", "catheter_1_tip_z_mm"):
        np.testing.assert_array_equal(motion[name][9::10], table[name][1:], err_msg=name)
    page = (folder / "navigation.html").read_text(encoding="utf-8")
    for part in ("--catheter microcatheter-1.7f", "Guidewire workhorse-014", "Catheter microcatheter-1.7f"):
        assert part in page
    assert "The catheter is turquoise, and covers what lies in it." in page
    assert "arrives: catheter; there is none" in refused(capsys, *command, "-o", tmp_path / "n")
    other = ("--controls", folder / "trajectory.npz", "--device", "wire-018", "-o", tmp_path / "no.npz")
    line = refused(capsys, "simulate", patient, *other)
    assert "was made with another (workhorse-014 in microcatheter-1.7f), not with this wire-018" in line


def test_the_picture_shows_wire_and_catheter(patient):
    config = NavigateConfig(tip="own", seconds=6.0, arrives="catheter")
    stack = Stack.of("workhorse-014", "microcatheter-1.7f")
    found = navigate(patient, "2", policy="in-turn", device=stack, config=config)
    record, motion = found.record, found.record.trajectory
    np.testing.assert_array_equal(record.tip_position[1:], motion.tip_position[0])
    outcome = tell_outcome(found)
    assert "after 6 s the catheter's tip is in section 1 at 0.0 mm" in outcome  # the wire goes first
    assert "it was still on its course; give more --seconds" in outcome
    route, tip, _, _, pushes, translation, rotation = navigation_figure(found).axes
    names = {axes: [text.get_text() for text in axes.get_legend().get_texts()] for axes in (route, tip, pushes)}
    assert {"wire's tip", "tip of microcatheter-1.7f"} < set(names[route])
    assert names[tip][:2] == ["wire's tip", "catheter's tip"]
    line = tip.lines[1]
    np.testing.assert_array_equal(line.get_ydata(), record.tip.abscissa[:, 1])
    assert names[pushes] == ["workhorse-014", "microcatheter-1.7f"]
    np.testing.assert_array_equal(pushes.lines[1].get_ydata(), motion.drive_force[0, :, 1])
    for axes, column in ((translation, 0), (rotation, 1)):
        for line, of_device in zip(axes.lines, record.control[..., column].T, strict=False):
            np.testing.assert_array_equal(line.get_ydata(), of_device)


def test_an_outcome_names_decisions_that_no_drive_can_follow(patient):
    class Lost:
        def start(self, navigation: Navigation, seed: int) -> None: ...

        def decide(self, observation: Observation) -> Decision:
            return Decision(devices=((float("nan"), 0.0),))

    found = navigate(patient, "2", policy=Lost(), config=NavigateConfig(tip="own", seconds=3.0))
    assert "before the target: 6 decisions were not finite, or beyond the drive's limits" in tell_outcome(found)


def test_the_episode_trains_beside_simulated_data(driven, patient, capsys, tmp_path):
    folder, _ = driven
    episode = read_dataset(folder / "episode")
    assert len(episode) == 1 and episode.valid.all() and episode.split.tolist() == ["train"]
    table = pd.read_csv(folder / "navigation.csv")
    np.testing.assert_allclose(episode.tip_abscissa[0, : len(table) - 1, 0], table["tip_abscissa_mm"][1:], atol=1e-4)
    assert episode.friction[0] == pytest.approx(0.12) and episode.tip_stiffness_factor[0] == 0.8
    sizes = ("--sequences", "4", "--seconds", "20")
    run(capsys, "dataset", patient, "-o", tmp_path / "data", *sizes)
    alone = run(capsys, "train", tmp_path / "data", "-o", tmp_path / "alone", "--epochs", "1", "--network", "ff")
    both = run(
        *(capsys, "train", tmp_path / "data", folder / "episode", "-o", tmp_path / "both"),
        *("--epochs", "1", "--network", "ff"),
    )
    assert np.isfinite(both["training"]["ff"]["curve"][-1]["loss"])
    counts = [read_json(tmp_path / name / "manifest.json")["episodes"]["train"] for name in ("alone", "both")]
    assert counts == [3, 4] and alone["training"] != both["training"]

    run(capsys, "dataset", patient, "-o", tmp_path / "long", "--sequences", "4", "--seconds", "30")
    line = refused(capsys, "train", tmp_path / "long", folder / "episode", "-o", tmp_path / "no")
    assert "episodes of 20 s, and those of" in line and "--seconds 30" in line


def test_a_finished_folder_is_left_alone_and_another_run_is_refused(driven, patient, capsys):
    folder, figures = driven
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    same = ("--seed", "3", "--world", folder.with_name("world.yaml"))
    same += ("--robot", folder.with_name("robot.yaml"))
    assert run(capsys, "navigate", patient, "--target", "2", "-o", folder, *SHORT, *same) == figures
    line = refused(capsys, "navigate", patient, "--target", "3", "-o", folder, *SHORT, *same)
    assert "was begun with target = 2, now it is 3" in line
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_an_interrupted_navigation_to_a_point_is_finished_by_the_same_command(patient, capsys, tmp_path):
    """The point lies beside the vessel, and is moved to it."""
    line, output = read_anatomy(patient).tree.branches[0].centerline, tmp_path / "killed"
    at = len(line.points) // 3
    target = ",".join(f"{value:.4f}" for value in line.points[at] + 0.7 * line.normals[at])
    command = ("navigate", patient, f"--target={target}", "-o", output, "--policy", "forward", *SHORT)
    run(capsys, *command)
    for last in ("manifest.json", "navigation.html"):  # as if it had been killed before
        (output / last).unlink()
    again = run(capsys, *command)
    assert sorted(path.name for path in output.iterdir()) == FILES
    page = (output / "navigation.html").read_text(encoding="utf-8")
    assert again["exposures"] == 1 and "Wires held possible" not in page
    assert again["snapped_mm"] == pytest.approx(0.7, abs=0.02)
    assert again["target_mm"] == pytest.approx(line.abscissa[at], abs=0.5)
    assert f"{again['snapped_mm']:.1f} mm from the given point" in again["outcome"]


def test_what_does_not_arrive_says_why(vessel, fork, capsys, tmp_path):
    def outcome(name: str, target: str, seconds: str) -> str:
        line = ("navigate", vessel, f"--target={target}", "-o", tmp_path / name, "--policy", "forward", "--tip", "own")
        figures = run(capsys, *line, "--seconds", seconds)
        assert not figures["reached"] and figures["reason"] == "time"
        return figures["outcome"]

    early = outcome("early", "0,0,36", "3")
    assert early.startswith("not reached: after 3 s the tip is in section vessel at ")
    assert "it was still on its course; give more --seconds" in early
    side = fork.tree.branches[2].centerline.points[-4]
    missed = outcome("missed", ",".join(f"{value:.3f}" for value in side), "8")
    assert "off the route, which it left at the fork at 20.0 mm" in missed and "give more" not in missed
