"""Learn from ten sessions of the cockpit: behaviour cloning of whoever drove them, tried in a new patient.

    python examples/behaviour_cloning.py                              # a scripted hand drives the ten sessions
    python examples/behaviour_cloning.py runs/cockpit/*.cockpit.jsonl     # your own, in task `straight`'s patients

Each session becomes a data set of one episode. A small network learns the hand's velocities from what X-ray shows: how
far the target is, and how far the tip lies off the centerline. As a policy it then drives a patient it has not seen.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from endopilot.anatomy.io import write_anatomy
from endopilot.cockpit.episode import write_session_episode
from endopilot.cockpit.recording import SUFFIX, Recorder, Where
from endopilot.cockpit.world import World
from endopilot.dataset.loader import load_dataset
from endopilot.navigation.navigate import navigate
from endopilot.navigation.policy import Decision, Observation
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import find_task

TASK, SESSIONS, SCALE = find_task("straight"), 10, np.array([10.0, 3.0])  # mm/s, rad/s


def hand(left_mm: float, time_s: float) -> tuple[float, float]:
    """Push fast from afar and slowly near the target, and turn to and fro."""
    return float(np.clip(0.6 * left_mm, 0.0, 9.0)), 0.8 * float(np.sin(2 * time_s))


def drive_session(number: int, folder: Path) -> Path:
    """Let the scripted hand drive one training patient, recorded as the cockpit records."""
    navigation = TASK.navigation(TASK.patient(TASK.training, number), start_rotation=0.6 * number)
    patient = folder / f"patient-{number}"
    write_anatomy(navigation.anatomy, patient)
    world = World(navigation, seed=number)
    path = folder / f"{number}{SUFFIX}"
    recorder = Recorder(path, world, Where(patient=patient), number)
    while world.time_s < 20.0:
        if world.cycle % 20 == 0:
            left_mm = navigation.target.abscissa - float(world.snapshot().tip.abscissa[0])
            recorder.event(move=world.command((hand(left_mm, world.time_s),))[0])
        world.advance()
        recorder.cycle()
    recorder.close()
    return path


def features(left_mm: np.ndarray, offset_mm: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.stack([left_mm / 50.0, np.tanh(left_mm / 10.0), offset_mm], axis=-1), dtype=torch.float32)


def clone(sessions: list[Path], folder: Path) -> torch.nn.Module:
    """Return a network that does what the hand did."""
    seen, done = [], []
    for number, session in enumerate(sessions):
        write_session_episode(session, folder / f"episode-{number}")
        data = load_dataset(folder / f"episode-{number}")
        target_mm = data.manifest["settings"]["target_mm"]
        seen.append(features(target_mm - data.tip_abscissa[0, :-1, 0], data.tip_offset[0, :-1, 0]))
        done.append(torch.tensor(data.control[0, 1:, 0] / SCALE, dtype=torch.float32))
    inputs, wanted = torch.cat(seen), torch.cat(done)
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 32), torch.nn.Tanh(), torch.nn.Linear(32, 2))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    for _ in range(600):
        loss = torch.nn.functional.mse_loss(network(inputs), wanted)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    print(
        f"{len(sessions)} sessions, {len(inputs)} samples: root mean square error {loss.item() ** 0.5:.3f} of {SCALE}"
    )
    return network


class Clone:
    """Drives as the hand did, with X-ray always on."""

    def __init__(self, network: torch.nn.Module) -> None:
        self._network = network

    def start(self, navigation: Navigation, seed: int) -> None:
        self._target_mm = navigation.target.abscissa

    def decide(self, observation: Observation) -> Decision:
        assert observation.tip is not None
        left_mm, offset_mm = self._target_mm - observation.tip.abscissa, observation.tip.offset
        with torch.no_grad():
            translation, rotation = self._network(features(np.array(left_mm), np.array(offset_mm))).numpy() * SCALE
        return Decision(((float(translation), float(rotation)),), expose=True)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = [Path(path) for path in sys.argv[1:]]
        sessions = given or [drive_session(number, folder) for number in range(SESSIONS)]
        network = clone(sessions, folder)
    navigation = replace(TASK.ladder_navigation(0), seconds=60.0)
    record = navigate(navigation, Clone(network), seed=1)
    print(
        f"in a new patient: {record.reason} after {record.seconds:g} s, largest wall force {record.peak_force_n:.3f} N"
    )
    assert record.success and record.safe


if __name__ == "__main__":
    main()
