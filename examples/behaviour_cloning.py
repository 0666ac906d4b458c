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
from functools import cache
from pathlib import Path

import numpy as np
import torch

import endopilot

TASK, SESSIONS, SCALE = endopilot.find_task("straight"), 10, np.array([10.0, 3.0])  # mm/s, rad/s


class ScriptedHand:
    """Pushes fast from afar and slowly near the target, and turns to and fro, with X-ray always on."""

    def start(self, navigation: endopilot.Navigation, seed: int) -> None:
        self._target_mm = navigation.target.abscissa

    def decide(self, observation: endopilot.Observation) -> endopilot.Decision:
        assert observation.tip is not None
        translation = np.clip(0.6 * (self._target_mm - observation.tip.abscissa), 0.0, 9.0)
        return endopilot.Decision(((float(translation), 0.8 * float(np.sin(2 * observation.time_s))),), expose=True)


@cache
def training_patient(place: int) -> endopilot.Anatomy:
    return TASK.patient(TASK.training, place)


def drive_session(number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what the scripted hand saw in one of three training patients, and what it did."""
    navigation = TASK.navigation(training_patient(number % 3), start_rotation_rad=0.6 * number)
    record = endopilot.NavigationLoop(replace(navigation, seconds=20.0), ScriptedHand(), seed=number).run()
    left_mm = navigation.target.abscissa - record.tip.abscissa[:-1, 0]
    return features(left_mm, record.tip.offset[:-1, 0]), torch.tensor(record.control[:-1, 0] / SCALE).float()


def read_session(session: Path, folder: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what a hand at the cockpit saw, and what it did."""
    endopilot.write_session_episode(session, output=folder)
    data = endopilot.read_dataset(folder)
    left_mm = data.manifest["settings"]["target_mm"] - data.tip_abscissa[0, :-1, 0]
    return features(left_mm, data.tip_offset[0, :-1, 0]), torch.tensor(data.control[0, 1:, 0] / SCALE).float()


def features(left_mm: np.ndarray, offset_mm: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.stack([left_mm / 50.0, np.tanh(left_mm / 10.0), offset_mm], axis=-1), dtype=torch.float32)


def clone(sessions: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.nn.Module:
    """Return a network that does what the hand did."""
    inputs, wanted = (torch.cat(each) for each in zip(*sessions, strict=True))
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

    def start(self, navigation: endopilot.Navigation, seed: int) -> None:
        self._target_mm = navigation.target.abscissa

    def decide(self, observation: endopilot.Observation) -> endopilot.Decision:
        assert observation.tip is not None
        left_mm, offset_mm = self._target_mm - observation.tip.abscissa, observation.tip.offset
        with torch.no_grad():
            translation, rotation = self._network(features(np.array(left_mm), np.array(offset_mm))).numpy() * SCALE
        return endopilot.Decision(((float(translation), float(rotation)),), expose=True)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        given = [read_session(Path(path), Path(name) / str(k)) for k, path in enumerate(sys.argv[1:])]
    network = clone(given or [drive_session(number) for number in range(SESSIONS)])
    navigation = replace(TASK.ladder_navigation(0), seconds=60.0)
    record = endopilot.NavigationLoop(navigation, Clone(network), seed=1).run()
    print(
        f"in a new patient: {record.reason} after {record.seconds:g} s, largest wall force {record.peak_force_n:.3f} N"
    )
    assert record.success and record.safe


if __name__ == "__main__":
    main()
