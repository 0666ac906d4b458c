"""What a predictor is given of navigations, `Episodes`, and what it returns, `OpenLoop`.

A dataset gives them by `Episodes.of_dataset`, a plan or a navigation under way by `Episodes.of_controls`;
`trained_patients` says which of them a run was trained on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Shaped

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset, check_same_wire
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import reading
from endopilot.models.config import WINDOW
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion, published_mean
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

AnyNetwork = TypeVar("AnyNetwork")


@dataclass(frozen=True, eq=False)
class Episodes:
    """Navigations of equal length as a predictor is given them. Sample t is the state at the end of period t.

    What a predictor may look at depends on what it predicts; see `Predictor`. A sample without a known tip may
    hold anything there, such as the tip that is desired.

    Attributes:
        anatomies: what reads each anatomy, by the anatomy's name; a distance map takes memory, so none is held here.
        device: the wire, or the wire in its catheters, as they are given.
        simulator: settings of the rod core.
        known_motions: what is known of how vessels move with heart and breath, by the anatomy's name; those that are
            not there, or None, lie still.
        anatomy: name of each episode's anatomy.
        start: (Δ mm, φ rad) of the wire and its catheters before the first period.
        control: π = (mm/s, rad/s) that the wire's drive made, the mean over each period.
        command: what the drives of wire and catheters were commanded (mm/s, rad/s), see `Dataset.command`.
        proximal: x^prox = (Δ mm, φ rad).
        tip: (Δtip, γtip), mm.
    """

    anatomies: Mapping[str, Callable[[], Anatomy]]
    device: Wire | Stack
    simulator: SimulatorConfig
    known_motions: Mapping[str, Motion | None]
    anatomy: Shaped[np.ndarray, "episodes"]
    start: Float[np.ndarray, "episodes devices 2"]
    control: Float[np.ndarray, "episodes samples 2"]
    command: Float[np.ndarray, "episodes samples devices 2"]
    proximal: Float[np.ndarray, "episodes samples 2"]
    tip: Float[np.ndarray, "episodes samples 2"]

    @staticmethod
    def of_dataset(dataset: Dataset) -> Episodes:
        """Return the navigations of a dataset, with their true tips. Of patients who move the published mean is known,
        with the phase of heart and breath. InputError where they are no longer than the states that are given."""
        samples = dataset.valid.shape[1]
        if samples <= WINDOW:
            seconds = (WINDOW + 1) * dataset.sample_period_s
            raise InputError(
                f"{dataset.folder}: episodes of {samples} samples leave nothing to predict after {WINDOW} given ones; "
                f"make the dataset with seconds of {seconds:g} or more"
            )
        with reading(dataset.folder, "make the dataset again"):
            device, simulator = dataset.stack, SimulatorConfig(**dataset.manifest["config"]["simulator"])
        motions = {name: dataset.motion(name) for name in dataset.patients}
        return Episodes(
            anatomies={name: partial(_read, dataset, name) for name in dataset.patients},
            device=device,
            simulator=simulator,
            known_motions={name: published_mean(motion) for name, motion in motions.items() if motion is not None},
            anatomy=dataset.anatomy,
            start=dataset.initial,
            control=dataset.control[:, :, 0],
            command=dataset.command,
            proximal=np.stack([dataset.inserted_length, dataset.rotation], axis=-1)[:, :, 0],
            tip=np.stack([dataset.tip_abscissa, dataset.tip_offset], axis=-1)[:, :, 0],
        )

    @staticmethod
    def of_controls(
        anatomy: Anatomy,
        device: Wire,
        *,
        initial: Float[np.ndarray, "2"],
        control: Float[np.ndarray, "episodes samples 2"],
        tip: Float[np.ndarray, "episodes samples 2"],
    ) -> Episodes:
        """Return navigations in one vessel whose drive makes exactly what it is commanded.

        Args:
            anatomy: the vessel.
            device: the wire.
            initial: (Δ mm, φ rad) before the first period.
            control: π = (mm/s, rad/s).
            tip: (Δtip, γtip), mm, as measured, desired or predicted.
        """
        return Episodes(
            anatomies={anatomy.name: lambda: anatomy},
            device=device,
            simulator=SimulatorConfig(threads=1),
            known_motions={},
            anatomy=np.full(len(control), anatomy.name),
            start=np.tile(initial, (len(control), 1, 1)),
            control=control,
            command=control[:, :, None].astype(float),
            proximal=initial + SAMPLE_PERIOD_S * np.cumsum(control, axis=1),
            tip=tip,
        )

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.anatomy)

    def select(self, chosen: Shaped[np.ndarray, "chosen"]) -> Episodes:
        """Return the chosen episodes, given as a mask or as indices."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        return replace(self, **{name: each[chosen] for name, each in arrays.items() if isinstance(each, np.ndarray)})


def _read(dataset: Dataset, name: str) -> Anatomy:
    return read_anatomy(dataset.anatomy_folder(name))


Steps2 = Float[np.ndarray, "episodes steps 2"]


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """What is predicted of each episode for the samples after the given ones.

    Attributes:
        tip: (Δtip, γtip), mm; the true tip in P2, where none is predicted.
        control: π = (mm/s, rad/s); the true one in P1.
    """

    tip: Steps2
    control: Steps2


@runtime_checkable
class Predictor(Protocol):
    """Whatever predicts episodes, whose first 30 states are given: the networks of a run, the simulated wires, or a
    baseline."""

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        ...

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        ...

    def rollout_dual(self, episodes: Episodes) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to."""
        ...


def needed(network: AnyNetwork | None, role: str) -> AnyNetwork:
    """Return a network of a run; InputError where it was not trained."""
    if network is None:
        raise InputError(f"the run has no {role} network; train it with --network both")
    return network


def check_wire(run: Path, record: Mapping[str, Any], dataset: Dataset) -> None:
    """Raise InputError for a dataset made with another wire than a run was trained with; simulated wires take any."""
    if record["device"] is not None:
        with reading(run, "train anew"):
            check_same_wire(dataset, record["device"], run, "make a dataset with the run's wire")


def trained_patients(run: Path, record: Mapping[str, Any], dataset: Dataset) -> frozenset[str]:
    """Return the names of the patients of a dataset that a run was trained on, by the SHA-256 of their anatomies;
    InputError for a dataset of another wire."""
    check_wire(run, record, dataset)
    trained = set(record["patients"])
    return frozenset(name for name, sha in dataset.patients.items() if sha in trained)
