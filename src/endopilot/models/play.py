"""Inputs of a network at every sample: geometry of the vessel, envelopes of the wire, and the play between them.

The play operator is the simplest hysteresis there is: an output that stays where it is until one of two curves takes it
along. Forward, the tip stays between the envelopes of a pushed and of a pulled wire as the inserted length changes;
inverse, the inserted length stays between theirs as the tip is to move. Both are one operator with the roles exchanged,
so both networks have the same inputs, `N_FEATURES` of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.devices.device import Wire
from endopilot.models.patient import STEP_MM, Patient

Direction = Literal["forward", "inverse"]
"""Forward: the drive is known and the tip follows. Inverse: the tip is known and the drive's motion is predicted."""
WINDOW_MM = (-40.0, -25.0, -15.0, -10.0, -6.0, -3.0, 0.0, 3.0, 6.0, 10.0, 15.0)
"""Where along the centerline, from the tip on, the vessel is looked at."""
PARTIAL_PLAYS = (0.25, 0.5, 0.75)
"""Further plays, as shares of the width between the envelopes."""
_AROUND_MM = np.array([0.0, -4.0, -2.0, 2.0, 4.0])
"""Where the envelopes are looked at: at the present place, and beside it, where a jump is a snap to come."""
_SHARPNESS = 20.0
"""Concentration of the von Mises kernel by which nominal wires count that are turned about as the wire is."""


@dataclass(frozen=True, eq=False)
class PlayState:
    """Where the play operator puts each wire.

    Attributes:
        tip: Δtip, mm.
        inserted: Δ, mm.
        partial: output of the plays of `PARTIAL_PLAYS`, mm.
    """

    tip: Float[np.ndarray, "n"]
    inserted: Float[np.ndarray, "n"]
    partial: Float[np.ndarray, "n plays"]
    branch: Int[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class PlayTables:
    """Tables of several patients, padded to one size; the first axis is the patient.

    Attributes:
        known: for each direction, (low, high) envelope of the other length over the known one, mm.
        clearance: (push, pull) distance between the wire at its tip and the wall over the inserted length, mm.
        deepest, leaf, on_route, leaf_of_branch, geometry, branch: as `patient.Patient` has them.
    """

    known: dict[str, tuple[Float[np.ndarray, "patients wires lengths"], Float[np.ndarray, "patients wires lengths"]]]
    clearance: tuple[Float[np.ndarray, "patients wires lengths"], Float[np.ndarray, "patients wires lengths"]]
    deepest: Float[np.ndarray, "patients wires"]
    leaf: Int[np.ndarray, "patients wires"]
    on_route: Bool[np.ndarray, "patients branches wires"]
    leaf_of_branch: Int[np.ndarray, "patients branches"]
    geometry: Float[np.ndarray, "patients leaves places 7"]
    branch: Int[np.ndarray, "patients leaves places"]
    wire_radius_mm: float

    @staticmethod
    def of(patients: Sequence[Patient], device: Wire) -> PlayTables:
        """Return the tables of patients that were prepared for a device."""
        motions = ("push", "pull")
        push, pull = ([getattr(p, f"{motion}_tip") for p in patients] for motion in motions)
        clearance = (_padded([_clearance(p, motion, device.tip_radius_mm) for p in patients]) for motion in motions)
        return PlayTables(
            known={
                "forward": (_padded(push), _padded(pull)),
                "inverse": (_padded([_inverted(t) for t in pull]), _padded([_inverted(t) for t in push])),
            },
            clearance=(next(clearance), next(clearance)),
            deepest=np.stack([p.deepest for p in patients]),
            leaf=np.stack([p.leaf for p in patients]),
            on_route=_stacked([p.on_route for p in patients]),
            leaf_of_branch=_stacked([p.leaf_of_branch for p in patients]),
            geometry=_stacked([p.geometry for p in patients]),
            branch=_stacked([p.branch for p in patients]),
            wire_radius_mm=device.tip_radius_mm,
        )

    def start(
        self, patient: Int[np.ndarray, "n"], inserted: Float[np.ndarray, "n"], rotation: Float[np.ndarray, "n"]
    ) -> PlayState:
        """Return wires that were pushed to where they are from the ostium."""
        branch = np.zeros(len(patient), dtype=np.int64)
        tip = np.zeros(len(patient))
        for _ in range(3):  # into the branch that a wire turned so comes to
            weight = self._weight(patient, branch, inserted, rotation)
            tip = _mixed(weight, _looked_up(self.known["forward"][0], patient, inserted))
            branch = self._branch(patient, self._leaf(patient, branch, weight), tip)
        return PlayState(tip, inserted.copy(), np.repeat(tip[:, None], len(PARTIAL_PLAYS), axis=1), branch)

    def step(
        self,
        direction: Direction,
        patient: Int[np.ndarray, "n"],
        state: PlayState,
        known: Float[np.ndarray, "n"],
        rotation: Float[np.ndarray, "n"],
        turned: Float[np.ndarray, "n"],
    ) -> tuple[PlayState, Float[np.ndarray, "n features"], Float[np.ndarray, "n"]]:
        """Take the plays one sample on.

        Args:
            known: Δ (forward) or Δtip (inverse) at its end, mm.
            rotation: φ at its end, rad.
            turned: by how much it has changed, rad.

        Returns:
            The state after it, the network's features, and γtip by the nominal wires' clearance, mm.
        """
        forward = direction == "forward"
        before, output = (state.inserted, state.tip) if forward else (state.tip, state.inserted)
        weight = self._weight(patient, state.branch, known if forward else state.inserted, rotation)
        around = known[:, None] + _AROUND_MM
        values = [_looked_up(table, patient, around) for table in self.known[direction]]
        here = [value[:, 0] for value in values]
        low, high = (_mixed(weight, value) for value in here)
        low, high = np.minimum(low, high), np.maximum(low, high)
        moved = np.clip(output, low, high)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        shares = np.array(PARTIAL_PLAYS) * half[:, None]
        partial = np.clip(state.partial, middle[:, None] - shares, middle[:, None] + shares)
        tip, inserted = (moved, known) if forward else (known, moved)
        leaf = self._leaf(patient, state.branch, weight)
        after = PlayState(tip, inserted, partial, self._branch(patient, leaf, tip))
        beside = [
            _mixed(weight, value[:, 1:]) - around[:, 1:] - (edge - known)[:, None]
            for value, edge in zip(values, (low, high), strict=True)
        ]
        clear = [_looked_up(table, patient, inserted) for table in self.clearance]
        clearance = [_mixed(weight, value) for value in clear]
        share = np.divide(moved - low, high - low, out=np.full(len(low), 0.5), where=high - low > 1e-6)
        pulled = share if forward else 1 - share
        radius = self._geometry(patient, leaf, tip[:, None])[:, 0, 3]
        off_axis = np.maximum(radius - self.wire_radius_mm - (1 - pulled) * clearance[0] - pulled * clearance[1], 0.0)
        sharp = weight**4 / (weight**4).sum(axis=1, keepdims=True)
        nearest, nearest_clearance = ([_mixed(sharp, value) for value in found] for found in (here, clear))
        columns = [
            inserted,
            inserted - tip,
            moved - low,
            high - moved,
            moved - output,
            *(partial - moved[:, None]).T,
            known - before,
            turned,
            np.abs(turned),
            _spread(weight, here[0]),
            *np.concatenate(beside, axis=1).T,
            *clearance,
            nearest[0] - low,
            nearest[1] - high,
            *nearest_clearance,
            self.deepest[patient].max(axis=1) - inserted,
            *self._nearby_geometry(patient, leaf, tip, rotation).T,
        ]
        return after, np.stack(columns, axis=-1), off_axis

    def _weight(self, patient, branch, inserted, rotation) -> Float[np.ndarray, "n wires"]:
        """Return how much each nominal wire counts: turned about as this one is, and able to be in its branch."""
        wires = self.deepest.shape[1]
        angle = 2 * np.pi * np.arange(wires) / wires
        kernel = np.exp(_SHARPNESS * (np.cos(rotation[:, None] - angle) - 1.0)) + 1e-6
        fits = self.on_route[patient, branch]
        near = fits & (self.deepest[patient] > inserted[:, None] - 1.0)
        weight = kernel * np.where(near, 1.0, np.where(fits, 1e-4, 1e-9))
        return weight / weight.sum(axis=1, keepdims=True)

    def _leaf(self, patient, branch, weight) -> Int[np.ndarray, "n"]:
        """Return the path to a distal end that each wire is on."""
        likeliest = weight.argmax(axis=1)
        led = self.on_route[patient, branch, likeliest]
        return np.where(led, self.leaf[patient, likeliest], self.leaf_of_branch[patient, branch])

    def _branch(self, patient, leaf, tip) -> Int[np.ndarray, "n"]:
        at = np.minimum(np.maximum(np.rint(tip / STEP_MM).astype(int), 0), self.branch.shape[2] - 1)
        return self.branch[patient, leaf, at]

    def _geometry(self, patient, leaf, at) -> Float[np.ndarray, "n places 7"]:
        place = np.minimum(np.maximum(at / STEP_MM, 0.0), self.geometry.shape[2] - 1.001)
        index = place.astype(int)
        share = (place - index)[..., None]
        rows = patient[:, None], leaf[:, None]
        return (1 - share) * self.geometry[*rows, index] + share * self.geometry[*rows, index + 1]

    def _nearby_geometry(self, patient, leaf, tip, rotation) -> Float[np.ndarray, "n columns"]:
        found = self._geometry(patient, leaf, tip[:, None] + np.array(WINDOW_MM))
        cosine, sine = np.cos(rotation)[:, None], np.sin(rotation)[:, None]
        along = found[..., 0] * cosine + found[..., 1] * sine
        across = found[..., 1] * cosine - found[..., 0] * sine
        here = len([w for w in WINDOW_MM if w < 0])
        return np.concatenate(
            [along, across, found[..., 2], found[..., 3] - self.wire_radius_mm, found[:, here, 4:7]], axis=1
        )


_N_LEADING = 8 + len(PARTIAL_PLAYS) + 1 + 2 * (len(_AROUND_MM) - 1) + 7
N_FEATURES = _N_LEADING + 4 * len(WINDOW_MM) + 3
"""Number of features of a sample."""


def mirrored() -> Float[np.ndarray, "features"]:
    """Return the sign that each feature takes in the mirror: a mirrored vessel and wire behave the same."""
    sign = np.ones(N_FEATURES)
    sign[6 + len(PARTIAL_PLAYS)] = -1.0  # the turn
    places = len(WINDOW_MM)
    first = _N_LEADING
    sign[first : first + places] = -1.0  # what a wire bent in its y-z plane calls sideways
    sign[first + 2 * places : first + 3 * places] = -1.0  # torsion
    return sign


def _looked_up(table, patient, at) -> Float[np.ndarray, "n *places wires"]:
    """Return every nominal wire's value at some lengths, carried on with slope 1 beyond the tables."""
    place = at / STEP_MM
    index = np.minimum(np.maximum(place.astype(int), 0), table.shape[2] - 2)
    share = (place - index)[..., None]
    row = patient if at.ndim == 1 else patient[:, None]
    before, after = table[row, :, index], table[row, :, index + 1]
    return before + share * (after - before)


def _mixed(weight, values) -> Float[np.ndarray, "n *places"]:
    return np.einsum("nk,n...k->n...", weight, values)


def _spread(weight, values) -> Float[np.ndarray, "n"]:
    """Return how far nominal wires differ that could be in the same place, turned by any angle, mm."""
    share = np.sqrt(weight)  # a wider kernel
    share = share / share.sum(axis=1, keepdims=True)
    mean = (share * values).sum(axis=1, keepdims=True)
    return np.sqrt((share * (values - mean) ** 2).sum(axis=1))


def _inverted(tip: Float[np.ndarray, "wires lengths"]) -> Float[np.ndarray, "wires lengths"]:
    """Return the inserted length at which each wire's tip first comes to an abscissa."""
    lengths = STEP_MM * np.arange(tip.shape[1])
    rising = np.maximum.accumulate(tip, axis=1) + 1e-6 * lengths
    return np.stack(
        [
            np.interp(lengths, row, lengths) + np.minimum(0, lengths - row[0]) + np.maximum(0, lengths - row[-1])
            for row in rising
        ]
    )


def _clearance(patient: Patient, motion: str, wire_radius_mm: float) -> Float[np.ndarray, "wires lengths"]:
    """Return the distance between wire and wall at the tips of nominal wires, mm, pushed or pulled."""
    tip, offset = getattr(patient, f"{motion}_tip"), getattr(patient, f"{motion}_offset")
    radius = patient.geometry[patient.leaf, :, 3]
    places = STEP_MM * np.arange(radius.shape[1])
    return np.stack([np.interp(row, places, r) for row, r in zip(tip, radius, strict=True)]) - wire_radius_mm - offset


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays as one, each padded with its last values to the largest size."""
    shape = np.max([part.shape for part in parts], axis=0)
    return np.stack([np.pad(p, [(0, n - m) for n, m in zip(shape, p.shape, strict=True)], mode="edge") for p in parts])


def _padded(parts: Sequence[Float[np.ndarray, "wires _"]]) -> Float[np.ndarray, "patients wires lengths"]:
    """Return tables of a length as one, each carried on as it ends."""
    width = max(part.shape[1] for part in parts)
    out = []
    for part in parts:
        more = STEP_MM * np.arange(1, width - part.shape[1] + 1)
        slope = part[:, -1:] - part[:, -2:-1]
        out.append(np.concatenate([part, part[:, -1:] + slope * more / STEP_MM], axis=1))
    return np.stack(out)
