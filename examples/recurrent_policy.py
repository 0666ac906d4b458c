"""The policy that `recurrent_ppo.py` trained: a network alone, which decides in less than a millisecond.

    python examples/recurrent_policy.py
    endopilot ladder --policy examples/recurrent_policy.py:Recurrent --tasks crux --patients 5

It is given what an environment observes under X-ray, and simulates nothing: a memory holds what exposures, encoders and
loads have shown. docs/evidence/environments.md has its scores.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import endopilot
from endopilot.anatomy.projection import TipProjector
from endopilot.env.exposures import Exposed
from endopilot.env.observation import RouteTables, observe_exposed
from endopilot.env.vector import ROTATION_RAD_S, TRANSLATION_MM_S
from endopilot.tasks.task import reference_navigation

WEIGHTS = Path(__file__).parent / "policies" / "recurrent.npz"


class Recurrent:
    """Drives as a recurrent network has learned to; the network decides when X-ray is on, too."""

    def __init__(self, weights: Path = WEIGHTS) -> None:
        with np.load(weights) as file:
            self._weights = {name: file[name].astype(float) for name in file.files}

    def start(self, navigation: endopilot.Navigation, seed: int) -> None:
        if navigation.catheters:
            raise endopilot.InputError("policy: the network drives a wire alone; leave the catheters out")
        self._project = TipProjector(navigation.anatomy.tree, navigation.anatomy.insertion)
        self._routes, self._seconds = RouteTables.of([navigation]), navigation.seconds
        self._memory = np.zeros(len(self._weights["memory.weight_hh"].T))
        self._random = np.random.default_rng(seed)
        self._exposed: Exposed | None = None

    def decide(self, observation: endopilot.Observation) -> endopilot.Decision:
        """Draw motions, and whether X-ray is on next, as in training: who is caught tries something else."""
        if observation.tip is not None:
            self._exposed = self._shown(observation)
        if self._exposed is None:  # no wire was found in the first image: look again
            return endopilot.Decision(expose=True)
        drive = np.column_stack([observation.devices, observation.load])[None]
        time_s = np.array([observation.time_s])
        (seen,) = observe_exposed(drive, self._exposed, self._routes, time_s, time_s / self._seconds)
        self._remember(np.tanh(self._dense("encoder.2", np.tanh(self._dense("encoder.0", seen)))))
        drawn = np.exp(self._weights["log_std"]) * self._random.standard_normal(3)
        forward, turn, look = np.clip(self._dense("actor", self._memory) + drawn, -1.0, 1.0).tolist()
        return endopilot.Decision(((TRANSLATION_MM_S * forward, ROTATION_RAD_S * turn),), expose=bool(look > 0.0))

    def _shown(self, observation: endopilot.Observation) -> Exposed:
        position = observation.tip.position[None]
        return Exposed(
            count=np.zeros(1, dtype=np.int64),
            time_s=np.array([observation.time_s]),
            encoders=np.array(observation.devices[:1]),
            position=position,
            tip=self._project(position)[:, None],
            image=np.zeros((1, 0, 0, 0), dtype=np.uint8),
            random=[],
        )

    def _dense(self, name: str, values: np.ndarray) -> np.ndarray:
        return self._weights[f"{name}.weight"] @ values + self._weights[f"{name}.bias"]

    def _remember(self, observed: np.ndarray) -> None:
        """Step the gated recurrent unit (Cho et al., EMNLP 2014), as torch.nn.GRUCell has it."""
        of, memory = self._weights, self._memory
        new = np.split(of["memory.weight_ih"] @ observed + of["memory.bias_ih"], 3)
        old = np.split(of["memory.weight_hh"] @ memory + of["memory.bias_hh"], 3)
        reset, keep = (1.0 / (1.0 + np.exp(-new[k] - old[k])) for k in (0, 1))
        self._memory = (1.0 - keep) * np.tanh(new[2] + reset * old[2]) + keep * memory


def main() -> None:
    # A patient of another population than those that the network was trained in, from three rotations.
    given, safe = reference_navigation(), {"recurrent": 0, "forward": 0}
    for name, policy in {"recurrent": Recurrent(), "forward": endopilot.make_policy("forward")}.items():
        for turn in (0.5, 2.5, 4.5):
            loop = endopilot.NavigationLoop(replace(given, start_rotation_rad=turn), policy, seed=1)
            record = loop.run()
            safe[name] += record.success and record.safe
            median_ms = 1e3 * float(np.median(loop.decision_s))
            print(f"{name}: {record.reason}, {record.exposures} exposures, {median_ms:.2f} ms a decision")
    assert safe["recurrent"] > safe["forward"]


if __name__ == "__main__":
    main()
