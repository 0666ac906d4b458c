"""What happened in a navigation: `NavigationRecord`, and `Track`, which gathers it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.projection import project_tip
from endopilot.navigation.policy import BelievedTip, Proximals
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class NavigationRecord:
    """A navigation as it truly went: a sample at the start and one after each decision period.

    Attributes:
        time_s: s.
        inserted_length: Δ, mm.
        rotation: φ, rad.
        tip_position: LPS mm.
        tip: Δtip, γtip, branch and lumen radius.
        contact_force_max: largest wall force on one node over the period that ends here, N.
        exposed: whether X-ray was on at this moment.
        catheter_inserted_length: of each catheter, mm.
        catheter_rotation: of each catheter, rad.
        catheter_tip_position: of each catheter, LPS mm.
        catheter_tips: Δtip, γtip, branch and lumen radius of each catheter.
        control: what was commanded from this moment on, within the limits, mm/s and rad/s of the wire, then of each
            catheter; 0 at the end.
        measured: what X-ray showed at this moment; None where it was off, or no wire was found in the images.
        believed: where the policy believed the tip to be when it decided; NaN at the end, and None for a policy that
            does not tell: (Δtip, γtip), mm.
        half_width: of the adviser's bands around it, mm, likewise; NaN where there is none.
        asks: why the policy asked at this moment for X-ray at the next one; empty where it did not, or does not tell.
        driven: velocity of each device's proximal end that its drive asked for in each cycle of `CYCLE_S`, mm/s and
            rad/s of the wire, then of each catheter. `endopilot.simulate` makes the same navigation of it, to the bit.
        success: the tip reached the target in time, at the end of a period.
        safe: the wall force never exceeded the navigation's limit.
        seconds: how long it took, s.
        peak_force_n: largest wall force on one node, N.
        exposures: their number, of both views together as one.
        path_mm: length of the tip's path, sample to sample, mm.
        faults: decisions that were not finite or beyond the drive's limits, and were mended.
        reason: "reached", "time", "invalid" (the simulation failed), "gave up" (the policy did) or "stopped" (somebody
            ended it before).
        gives_up: where and why the policy gave up, in words; empty if it did not.
    """

    time_s: Float[np.ndarray, "samples"]
    inserted_length: Float[np.ndarray, "samples"]
    rotation: Float[np.ndarray, "samples"]
    tip_position: Float[np.ndarray, "samples 3"]
    tip: TipProjection
    contact_force_max: Float[np.ndarray, "samples"]
    exposed: Bool[np.ndarray, "samples"]
    catheter_inserted_length: Float[np.ndarray, "samples catheters"]
    catheter_rotation: Float[np.ndarray, "samples catheters"]
    catheter_tip_position: Float[np.ndarray, "samples catheters 3"]
    catheter_tips: tuple[TipProjection, ...]
    control: Float[np.ndarray, "samples numbers"]
    measured: tuple[TipMeasurement | None, ...]
    believed: Float[np.ndarray, "samples 2"] | None
    half_width: Float[np.ndarray, "samples 2"] | None
    asks: tuple[str, ...]
    driven: Float[np.ndarray, "cycles numbers"]
    success: bool
    safe: bool
    seconds: float
    peak_force_n: float
    exposures: int
    path_mm: float
    faults: int
    reason: str
    gives_up: str

    @property
    def tips(self) -> tuple[TipProjection, ...]:
        """Those of the wire and of each catheter, as `Navigation.reached` takes them."""
        return (self.tip, *self.catheter_tips)

    @property
    def in_bands(self) -> Bool[np.ndarray, "decisions"]:
        """Whether the adviser's bands held Δtip and γtip, at each decision that had bands."""
        if self.believed is None or self.half_width is None:
            return np.zeros(0, dtype=bool)
        true = np.stack([self.tip.abscissa, self.tip.offset], axis=-1)
        held = np.less_equal(np.abs(true - self.believed), self.half_width).all(axis=1)
        return np.asarray(held)[np.isfinite(self.half_width).all(axis=1)]


class Track:
    """Gathers what happens in a navigation."""

    def __init__(self, simulator: Simulator) -> None:
        """Take the start."""
        self._columns: dict[str, list] = {name: [] for name in ("inserted", "turned", "position", "force")}
        self._controls: list[Proximals] = []
        self._measured: list[TipMeasurement | None] = []
        self._exposed: list[bool] = []
        self._believed: list[BelievedTip | None] = []
        self._faults = 0
        self.moved(simulator, float(simulator.contacts.max()))

    def decided(
        self,
        control: Proximals,
        tip: TipMeasurement | None,
        believed: BelievedTip | None,
        *,
        exposed: bool,
        fault: bool,
    ) -> None:
        """Take what was decided, whether X-ray was on and what it showed then, and what the policy believed."""
        self._controls.append(control)
        self._exposed.append(exposed)
        self._measured.append(tip)
        self._believed.append(believed)
        self._faults += fault

    def moved(self, simulator: Simulator, peak_n: float) -> None:
        """Take where the devices are at the end of a period, and the largest wall force in it, N."""
        self._columns["inserted"].append(np.append(simulator.inserted_length, simulator.catheter_inserted_length))
        self._columns["turned"].append(np.append(simulator.rotation, simulator.catheter_rotation))
        devices = 1 + simulator.catheter_inserted_length.shape[1]
        self._columns["position"].append([simulator.tips(k)[0] for k in range(devices)])
        self._columns["force"].append(peak_n)

    def record(self, navigation: Navigation, driven: list[np.ndarray], reason: str, gives_up: str) -> NavigationRecord:
        """Return the record of what was gathered up to the end of the last period.

        Args:
            navigation: what was to be done.
            driven: velocity of each cycle of the drive, mm/s and rad/s.
            reason: why it ended.
            gives_up: where and why the policy gave up, in words.
        """
        anatomy = navigation.anatomy
        inserted, turned, position, force = (
            np.array(self._columns[name]) for name in ("inserted", "turned", "position", "force")
        )
        tip, *catheter_tips = (
            project_tip(anatomy.tree, anatomy.insertion, position[:, k]) for k in range(position.shape[1])
        )
        numbers = 2 * inserted.shape[1]
        periods = len(force) - 1  # a decision whose period is not over does not count
        measured = (*self._measured[:periods], None)
        believed = [_NOTHING if tip is None else tip for tip in self._believed[:periods]] + [_NOTHING]
        tells = any(tip is not None for tip in self._believed)
        return NavigationRecord(
            time_s=DECISION_PERIOD_S * np.arange(len(force)),
            inserted_length=inserted[:, 0],
            rotation=turned[:, 0],
            tip_position=position[:, 0],
            tip=tip,
            contact_force_max=force,
            exposed=np.array([*self._exposed[:periods], False]),
            catheter_inserted_length=inserted[:, 1:],
            catheter_rotation=turned[:, 1:],
            catheter_tip_position=position[:, 1:],
            catheter_tips=tuple(catheter_tips),
            control=np.array([*map(np.ravel, self._controls[:periods]), np.zeros(numbers)]),
            measured=measured,
            believed=np.array([(tip.abscissa, tip.offset) for tip in believed]) if tells else None,
            half_width=np.array([tip.half_width for tip in believed]) if tells else None,
            asks=tuple(tip.asks for tip in believed),
            driven=np.array(driven, dtype=float).reshape(-1, numbers),
            success=reason == "reached",
            safe=bool(force.max() <= navigation.force_limit_n),
            seconds=DECISION_PERIOD_S * periods,
            peak_force_n=float(force.max()),
            exposures=sum(self._exposed[:periods]),
            path_mm=float(np.linalg.norm(np.diff(position[:, 0], axis=0), axis=1).sum()),
            faults=self._faults,
            reason=reason,
            gives_up=gives_up,
        )


_NOTHING = BelievedTip(abscissa=np.nan, offset=np.nan)
