"""Random navigations of one anatomy that stay inside the vessel that was imaged.

A segmented vessel ends where the scan no longer shows it, not where blood stops: a wire that is pushed against that end
buckles against a wall that does not exist. So before every sample the drive checks the tip, as an operator does: it
stops pushing shortly before the end of the tip's branch. There, and where the wire is caught, it pulls instead of
pushing until the wire has come back far enough. Simulating the recorded controls without these checks gives the same
navigation again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.device import Device
from endopilot.simulation.drive_limits import within_travel
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import RECORDED, make_rollout
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, Rollout, TipProjection, VesselTree

STOP_SHORT_MM = 5.0
"""A tip is driven no nearer than this to the end of its branch, mm."""
PULL_BACK_MM = 15.0
"""Length by which a wire that came to an end, or is caught, is pulled back before it is pushed again, mm."""
CAUGHT = 0.5
"""Share of the device's push limit at which a wire counts as caught."""
_ROUNDING_MM = 1e-2
"""A wire this near to its pull-back target counts as pulled back."""


def simulate_navigations(
    anatomy: Anatomy,
    devices: Sequence[Device],
    initial: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    friction: Float[np.ndarray, "worlds"],
    config: SimulatorConfig,
    *,
    actuation: Actuation = "velocity",
    motion: Motion | None = None,
    advance: Callable[[int], None] = lambda samples: None,
) -> tuple[Rollout, Float[np.ndarray, "worlds samples 2"], Bool[np.ndarray, "worlds"]]:
    """Simulate navigations, stopped short of the ends of the vessel.

    Args:
        anatomy: the vessel.
        devices: the wire of each world.
        initial: (Δ mm, φ rad) before the first period.
        control: velocities (mm/s, rad/s) or loads (N, N·mm) that were drawn.
        friction: friction coefficient of each world.
        config: settings of the rod core.
        actuation: what the controls are.
        motion: how the vessel moves with time; it lies still if not given.
        advance: called after each sample with the number of worlds.

    Returns:
        The rollout; the controls that were applied, rounded to float32 as they are stored; and which worlds were
        stopped short.
    """
    watch = _PushRoom(anatomy.tree, devices)
    simulator = Simulator(anatomy, list(devices), actuation=actuation, motion=motion, config=config)
    started = _begin(simulator, watch, initial, friction)
    applied, stopped = np.empty_like(control), np.zeros(len(control), dtype=bool)
    result: dict[str, np.ndarray] = {}
    inserted, last, slip = started[:, 0], np.zeros(len(control)), np.zeros(len(control))
    for sample in range(control.shape[1]):
        drawn = control[:, sample]
        caught = (slip > 0) | (simulator.base_load[:, 0] > watch.caught_n)
        # How far a load moves the wire is not known: about as far as the last one did.
        needed = last if actuation == "force" else np.zeros(len(control))
        room = watch.room(simulator.project(), inserted, needed, caught)
        held = np.where(room > 0, drawn[:, 0], -np.abs(drawn[:, 0]))
        if actuation == "velocity":
            held = within_travel(np.minimum(held, room / SAMPLE_PERIOD_S), inserted, SAMPLE_PERIOD_S)
        applied[:, sample] = np.column_stack([held, drawn[:, 1]]).astype(np.float32)
        stopped |= (drawn[:, 0] > 0) & (held < drawn[:, 0])
        step = simulator.step(applied[:, sample], SAMPLE_PERIOD_S)
        _record(result, sample, control.shape[1], step, simulator)
        slip, last, inserted = step.slip, step.inserted_length - inserted, step.inserted_length
        advance(len(control))
    result["reason"] = simulator.reason
    return make_rollout(anatomy, actuation, started, applied, result), applied, stopped


class _PushRoom:
    """How far each wire may still be pushed.

    Attributes:
        deepest_mm: inserted length that no wire may exceed.
        caught_n: push at which each wire counts as caught, N.
    """

    def __init__(self, tree: VesselTree, devices: Sequence[Device]) -> None:
        self._ends = np.full(len(tree.branches), np.inf)
        for leaf in tree.leaves():
            self._ends[leaf] = tree.branches[leaf].centerline.abscissa[-1]
        self.deepest_mm = max(float(self._ends[np.isfinite(self._ends)].max()) - STOP_SHORT_MM, 0.0)
        self.caught_n = CAUGHT * np.array([device.push_limit_n for device in devices])
        self._limit = np.full(len(devices), np.inf)

    def room(
        self,
        tip: TipProjection,
        inserted: Float[np.ndarray, "worlds"],
        needed: Float[np.ndarray, "worlds"],
        caught: Bool[np.ndarray, "worlds"],
    ) -> Float[np.ndarray, "worlds"]:
        """Return the advance (mm) that is left to each wire; 0 where it is `needed` or less, or until it is back."""
        ahead = np.minimum(self.deepest_mm - inserted, self.ahead(tip))
        stop = caught | (ahead <= np.maximum(needed, _ROUNDING_MM))
        back = np.maximum(inserted - PULL_BACK_MM, 0.0)
        self._limit = np.where(stop, np.minimum(self._limit, back), self._limit)
        is_back = ~stop & (inserted < self._limit + _ROUNDING_MM)
        self._limit = np.where(is_back, np.inf, self._limit)
        return np.where(np.isinf(self._limit), ahead, 0.0)

    def ahead(self, tip: TipProjection) -> Float[np.ndarray, "worlds"]:
        """Return how far each tip is from where it is stopped in its branch, mm; negative beyond."""
        return self._ends[tip.branch] - STOP_SHORT_MM - tip.abscissa


def _begin(
    simulator: Simulator,
    watch: _PushRoom,
    initial: Float[np.ndarray, "worlds 2"],
    friction: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds 2"]:
    """Push the wires to their first inserted length, or as deep as they go freely, and return Δ and φ there."""
    start, again = np.minimum(initial[:, 0], watch.deepest_mm), np.arange(len(initial))
    while True:
        simulator.reset(inserted_length=start, rotation=initial[:, 1], friction=friction, worlds=again.tolist())
        tip = simulator.project()
        slipped = simulator.inserted_length < start
        far = np.where(slipped, STOP_SHORT_MM, -watch.ahead(tip))
        again = np.flatnonzero((slipped | (far > _ROUNDING_MM)) & (start > 0) & simulator.valid)
        if len(again) == 0:
            return np.column_stack([simulator.inserted_length, simulator.rotation])
        start[again] = np.maximum(simulator.inserted_length[again] - np.maximum(far[again], 1.0), 0.0)


def _record(result: dict[str, np.ndarray], sample: int, samples: int, step: Step, simulator: Simulator) -> None:
    """Put what the worlds did in one sample into arrays of all samples."""
    base, drive = simulator.base_load, simulator.drive_load
    loads = {
        "base_force": base[:, 0],
        "base_torque": base[:, 1],
        "drive_force": drive[:, 0],
        "drive_torque": drive[:, 1],
    }
    for name in (*RECORDED, "inserted_length", "rotation"):
        values = loads[name] if name in loads else getattr(step, name)
        if sample == 0:
            result[name] = np.empty((len(values), samples, *values.shape[1:]), dtype=values.dtype)
        result[name][:, sample] = values
