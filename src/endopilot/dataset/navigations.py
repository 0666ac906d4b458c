"""Random navigations of one anatomy that stay inside the vessel that was imaged.

A segmented vessel ends where the scan no longer shows it, not where blood stops: a wire that is pushed against that end
buckles against a wall that does not exist. So before every sample the drive checks the tip, as an operator does: it
stops pushing shortly before the end of the tip's branch. There, and where the wire is caught, it pulls instead of
pushing until the wire has come back far enough. Simulating the recorded controls without these checks gives the same
navigation again. Catheters around the wire are held back by the same rules, each by its own tip and load.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device
from endopilot.devices.drive_limits import within_travel
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.core import of_device
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import RECORDED, catheter_motion, make_rollout
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
    initial: Float[np.ndarray, "worlds numbers"],
    control: Float[np.ndarray, "worlds samples numbers"],
    friction: Float[np.ndarray, "worlds"],
    config: SimulatorConfig,
    *,
    catheters: Sequence[Catheter] = (),
    actuation: Actuation = "velocity",
    motion: Motion | None = None,
    advance: Callable[[int], None] = lambda samples: None,
) -> tuple[
    Rollout,
    Float[np.ndarray, "worlds numbers"],
    Float[np.ndarray, "worlds samples numbers"],
    Bool[np.ndarray, "worlds"],
]:
    """Simulate navigations, stopped short of the ends of the vessel.

    Args:
        anatomy: the vessel.
        devices: the wire of each world.
        initial: (Δ mm, φ rad) before the first period, of the wire, then of each catheter.
        control: velocities (mm/s, rad/s) or loads (N, N·mm) that were drawn, likewise.
        friction: friction coefficient of each world.
        config: settings of the rod core.
        catheters: around the wires, from the inside out; driven by velocity.
        actuation: what the controls are.
        motion: how the vessel moves with time; it lies still if not given.
        advance: called after each sample with the number of worlds.

    Returns:
        The rollout; Δ and φ that it is simulated again from; the controls that were applied, rounded to float32 as
        they are stored; and which worlds were stopped short.
    """
    stack = [list(devices), *([catheter.device] * len(devices) for catheter in catheters)]
    watch = _PushRoom(anatomy.tree, stack)
    simulator = Simulator(
        anatomy, list(devices), catheters=catheters, actuation=actuation, motion=motion, config=config
    )
    started = _begin(simulator, watch, initial, friction)
    applied, stopped = np.empty_like(control), np.zeros(len(control), dtype=bool)
    result: dict[str, np.ndarray] = {}
    inserted, last, slip = _inserted(simulator), np.zeros_like(started[:, ::2]), np.zeros_like(started[:, ::2])
    for sample in range(control.shape[1]):
        drawn = control[:, sample, ::2]
        base = np.column_stack([simulator.base_load[:, 0], simulator.catheter_base_load[..., 0]])
        caught = (slip > 0) | (base > watch.caught_n)
        # How far a load moves the wire is not known: about as far as the last one did.
        needed = last if actuation == "force" else np.zeros_like(last)
        room = watch.room(_project(simulator), inserted, needed, caught)
        held = np.where(room > 0, drawn, -np.abs(drawn))
        if actuation == "velocity":
            held = within_travel(np.minimum(held, room / SAMPLE_PERIOD_S), inserted, SAMPLE_PERIOD_S)
        made = control[:, sample].copy()
        made[:, ::2] = held
        applied[:, sample] = made.astype(np.float32)
        stopped |= ((drawn > 0) & (held < drawn)).any(axis=1)
        step = simulator.step(applied[:, sample], SAMPLE_PERIOD_S)
        _record(result, sample, control.shape[1], step, simulator)
        now = _inserted(simulator)
        slip, last, inserted = np.column_stack([step.slip, simulator.catheter_slip[..., 0]]), now - inserted, now
        advance(len(control))
    result["reason"] = simulator.reason
    wire = of_device(result, 0)
    rollout = make_rollout(anatomy, actuation, started[:, :2], applied[..., :2], wire)
    if catheters:
        rollout = replace(
            rollout,
            inserted_length=wire["inserted_length"],
            rotation=wire["rotation"],
            catheters=catheter_motion(applied, result, SAMPLE_PERIOD_S),
        )
    return rollout, started, applied, stopped


class _PushRoom:
    """How far each device may still be pushed. Arrays have a row a world and a column a device, the wire first.

    Attributes:
        deepest_mm: inserted length that no device may exceed.
        caught_n: push at which each counts as caught, N.
    """

    def __init__(self, tree: VesselTree, stack: Sequence[Sequence[Device]]) -> None:
        self._ends = np.full(len(tree.branches), np.inf)
        for leaf in tree.leaves():
            self._ends[leaf] = tree.branches[leaf].centerline.abscissa[-1]
        self.deepest_mm = max(float(self._ends[np.isfinite(self._ends)].max()) - STOP_SHORT_MM, 0.0)
        self.caught_n = CAUGHT * np.array([[device.push_limit_n for device in each] for each in stack]).T
        self._limit = np.full(self.caught_n.shape, np.inf)

    def room(
        self,
        tip: TipProjection,
        inserted: Float[np.ndarray, "worlds devices"],
        needed: Float[np.ndarray, "worlds devices"],
        caught: Bool[np.ndarray, "worlds devices"],
    ) -> Float[np.ndarray, "worlds devices"]:
        """Return the advance (mm) that is left to each; 0 where it is `needed` or less, or until it is back."""
        ahead = np.minimum(self.deepest_mm - inserted, self.ahead(tip))
        stop = caught | (ahead <= np.maximum(needed, _ROUNDING_MM))
        back = np.maximum(inserted - PULL_BACK_MM, 0.0)
        self._limit = np.where(stop, np.minimum(self._limit, back), self._limit)
        is_back = ~stop & (inserted < self._limit + _ROUNDING_MM)
        self._limit = np.where(is_back, np.inf, self._limit)
        return np.where(np.isinf(self._limit), ahead, 0.0)

    def ahead(self, tip: TipProjection) -> Float[np.ndarray, "worlds devices"]:
        """Return how far each tip is from where it is stopped in its branch, mm; negative beyond."""
        return self._ends[tip.branch] - STOP_SHORT_MM - tip.abscissa


def _begin(
    simulator: Simulator,
    watch: _PushRoom,
    initial: Float[np.ndarray, "worlds numbers"],
    friction: Float[np.ndarray, "worlds"],
) -> Float[np.ndarray, "worlds numbers"]:
    """Push the devices to their first inserted length, or as deep as they go freely.

    Returns:
        Δ and φ of a wire alone as it then lies; of wire and catheters what they were pushed to, from which they are
        simulated again to the bit, though one may carry the other a little farther.
    """
    start, turn, again = np.minimum(initial[:, ::2], watch.deepest_mm), initial[:, 1::2], np.arange(len(initial))
    while True:
        simulator.reset(
            inserted_length=start[:, 0],
            rotation=turn[:, 0],
            friction=friction,
            catheter_inserted_length=start[:, 1:],
            catheter_rotation=turn[:, 1:],
            worlds=again.tolist(),
        )
        inserted = _inserted(simulator)
        slipped = inserted != start  # a weakly driven device is also carried along by another one
        far = np.where(slipped, STOP_SHORT_MM, -watch.ahead(_project(simulator)))
        bad = (slipped | (far > _ROUNDING_MM)) & (start > 0) & simulator.valid[:, None]
        again = np.flatnonzero(bad.any(axis=1))
        if len(again) == 0:
            if inserted.shape[1] > 1:  # pushed there again, they slip again
                return np.stack([start, turn], axis=-1).reshape(initial.shape)
            return np.column_stack([inserted, simulator.rotation])
        start[bad] = np.maximum(np.minimum(inserted, start)[bad] - np.maximum(far[bad], 1.0), 0.0)


def _inserted(simulator: Simulator) -> Float[np.ndarray, "worlds devices"]:
    return np.column_stack([simulator.inserted_length, simulator.catheter_inserted_length])


def _project(simulator: Simulator) -> TipProjection:
    """Return where all tips lie, a column a device."""
    tips = [simulator.project(k) for k in range(1 + simulator.catheter_rotation.shape[1])]
    names = TipProjection.__dataclass_fields__
    return TipProjection(**{name: np.column_stack([getattr(tip, name) for tip in tips]) for name in names})


def _record(result: dict[str, np.ndarray], sample: int, samples: int, step: Step, simulator: Simulator) -> None:
    """Put what the worlds did in one sample into arrays of all samples, as `run_core` returns them."""
    of_devices = _of_devices(simulator)
    for name in dict.fromkeys((*RECORDED, *of_devices)):
        values = of_devices[name] if name in of_devices else getattr(step, name)
        if sample == 0:
            result[name] = np.empty((len(values), samples, *values.shape[1:]), dtype=values.dtype)
        result[name][:, sample] = values


def _of_devices(simulator: Simulator) -> dict[str, Float[np.ndarray, "worlds devices *numbers"]]:
    """Return what a simulator reads of each device, the wire first."""
    count = 1 + simulator.catheter_rotation.shape[1]
    base = np.concatenate([simulator.base_load[:, None], simulator.catheter_base_load], axis=1)
    drive = np.concatenate([simulator.drive_load[:, None], simulator.catheter_drive_load], axis=1)
    slip = np.concatenate([simulator.slip[:, None], simulator.catheter_slip], axis=1)
    return {
        "inserted_length": np.column_stack([simulator.inserted_length, simulator.catheter_inserted_length]),
        "rotation": np.column_stack([simulator.rotation, simulator.catheter_rotation]),
        "tip_position": np.stack([simulator.tips(k) for k in range(count)], axis=1),
        "tip_direction": simulator.tip_direction[:, None],
        "base_force": base[..., 0],
        "base_torque": base[..., 1],
        "drive_force": drive[..., 0],
        "drive_torque": drive[..., 1],
        "slip": slip[..., 0],
        "rotation_slip": slip[..., 1],
    }
