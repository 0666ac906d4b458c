"""What happened in a navigation: `NavigationRecord`, and `Track`, which gathers it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.projection import project_tip, safety_ratio
from endopilot.belief.bands import AdviserConfig
from endopilot.belief.events import Counted, astray_mm, count_events
from endopilot.navigation.policy import BelievedTip, Observation, Proximals
from endopilot.robot.robot import SimulatedRobot
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import Trajectory
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, is_safe
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class NavigationRecord:
    """A navigation as it truly went: a sample at the start and one after each decision period.

    Where an array has an axis of devices, the wire comes first, then the catheters around it from the inside out.

    Attributes:
        time_s: s.
        inserted_length: Δ of each device, mm.
        rotation: φ of each device, rad.
        encoders: Δ, mm, and φ, rad, of each device as the policy was given them; NaN at the end and where nobody asked.
        load: axial force, N, and torque, N·mm, of each drive, likewise.
        tip_position: LPS mm.
        tip: Δtip, γtip, branch and lumen radius, with a row a sample and a column a device.
        shape: nodes of the line that the devices share, from the foremost tip on, LPS mm.
        contact_force_max: largest wall force on one node over the period that ends here, N.
        exposed: whether X-ray was on at this moment, or in the period that follows if a hand drove.
        control: what was commanded from this moment on, within the limits, mm/s and rad/s; 0 at the end.
        measured: what X-ray showed at this moment; None where it was off, or no wire was found in the images.
        believed: where the policy believed the tip to be when it decided; NaN at the end, and None for a policy that
            does not tell: (Δtip, γtip), mm.
        astray_mm: how far along the vessel the tip lay from there, by way of the fork where it lay in another branch.
        half_width: of the adviser's bands around it, mm, likewise; NaN where there is none, infinite where the policy
            could not explain what X-ray showed.
        asks: why the policy asked at this moment for X-ray at the next one; empty where it did not, or does not tell.
        found: what was identified once the model was taken to be wrong, in words; empty if nothing was.
        cycles: what the drives asked for in each of their cycles and what the devices truly did, without shapes;
            replayed it gives the same navigation to the bit. Its columns `encoders` and `load` are what the robot
            measured at the end of each cycle; others repeat over a period's cycles what was `decided`, `measured` and
            `believed`, and the `half_width`. `about` tells target, end and exposures. None where no period is over.
        success: the tip reached the target in time, at the end of a period.
        safe: the wall force never exceeded the navigation's limit.
        seconds: how long it took, s.
        peak_force_n: largest wall force on one node, N.
        exposures: their number, of both views together as one.
        path_mm: length of the wire's tip's path, sample to sample, mm.
        faults: decisions that were not finite or beyond the robot's limits, and were mended.
        reason: "reached", "time", "invalid" (the simulation failed), "gave up" (the policy did) or "stopped" (somebody
            ended it before).
        gives_up: where and why the policy gave up, in words; empty if it did not.
    """

    time_s: Float[np.ndarray, "samples"]
    inserted_length: Float[np.ndarray, "samples devices"]
    rotation: Float[np.ndarray, "samples devices"]
    encoders: Float[np.ndarray, "samples devices 2"]
    load: Float[np.ndarray, "samples devices 2"]
    tip_position: Float[np.ndarray, "samples devices 3"]
    tip: TipProjection
    shape: Float[np.ndarray, "samples nodes 3"]
    contact_force_max: Float[np.ndarray, "samples"]
    exposed: Bool[np.ndarray, "samples"]
    control: Float[np.ndarray, "samples devices 2"]
    measured: tuple[TipMeasurement | None, ...]
    believed: Float[np.ndarray, "samples 2"] | None
    astray_mm: Float[np.ndarray, "samples"]
    half_width: Float[np.ndarray, "samples 2"] | None
    asks: tuple[str, ...]
    found: str
    cycles: Trajectory | None
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
    def trajectory(self) -> Trajectory:
        """The true motion at the end of each decision period, with the shape of the line that the devices share;
        ValueError where no period is over.
        """
        if self.cycles is None:
            raise ValueError("nothing was driven yet")
        return replace(self.cycles.every(round(DECISION_PERIOD_S / self.cycles.period_s)), shape=self.shape[None, 1:])

    @property
    def in_bands(self) -> Bool[np.ndarray, "decisions"]:
        """Whether the adviser's bands held Δtip and γtip, at each decision with bands; infinite ones hold nothing."""
        if self.believed is None or self.half_width is None:
            return np.zeros(0, dtype=bool)
        off = np.stack([self.astray_mm, np.abs(self.tip.offset[:, 0] - self.believed[:, 1])], axis=-1)
        half = self.half_width
        held = (np.less_equal(off, half) & np.isfinite(half)).all(axis=1)
        return np.asarray(held)[~np.isnan(half).any(axis=1)]


def count_navigation_events(
    record: NavigationRecord, navigation: Navigation, advice: AdviserConfig | None = None
) -> dict[str, Counted]:
    """Return what X-ray had to show in a navigation, and what it missed (`belief.events`): contacts with the wall, tips
    that were astray of where the policy believed them, and forces beyond the limit. `advice` has τ and δ.
    """
    advice, tip = advice or AdviserConfig(), record.tip[:, 0]
    states = {
        "contact": safety_ratio(tip.offset, tip.radius, navigation.device.tip_radius_mm) >= advice.wall_ratio,
        "astray": record.astray_mm >= advice.abscissa_mm,
        "force": ~is_safe(record.contact_force_max, navigation.force_limit_n),
    }
    return {kind: count_events(state[:-1], record.exposed[:-1]) for kind, state in states.items()}


@dataclass(eq=False)
class Track:
    """What happens in a navigation: proximal state, tips, nodes and largest wall force (N) at the end of each period;
    what was decided, observed and believed at its begin; exposures before the first decision and in each period; and
    how many decisions were mended."""

    moved: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = field(default_factory=list)
    decided: list[tuple[Proximals, Observation | None, BelievedTip | None]] = field(default_factory=list)
    exposures: list[int] = field(default_factory=lambda: [0])
    faults: int = 0

    def record(
        self,
        navigation: Navigation,
        world: World,
        simulator: Simulator,
        robot: SimulatedRobot,
        reason: str,
        gives_up: str,
    ) -> NavigationRecord:
        """Return the record of what was gathered up to the end of the last period."""
        tree = simulator.set_up.anatomies[0].tree  # the radii at the tips are those of the true vessel
        proximal, position, shape, force = map(np.array, zip(*self.moved, strict=True))
        samples, devices, _ = proximal.shape
        periods = samples - 1  # a decision whose period is not over does not count
        cycles = periods * round(DECISION_PERIOD_S / robot.recorder.period_s)
        exposures = np.array([sum(self.exposures[:2]), *self.exposures[2 : periods + 1], 0] if periods else [0])
        control, seen, told = zip(*self.decided[:periods], strict=True) if periods else ((), (), ())
        believed = [_NOTHING if tip is None else tip for tip in told] + [_NOTHING]
        tells = any(tip is not None for *_, tip in self.decided)
        found = believed[-2].found if periods else ""
        where = np.array([(tip.abscissa, tip.offset) for tip in believed])
        half_width, branch = np.array([tip.half_width for tip in believed]), np.array([tip.branch for tip in believed])
        tip = project_tip(tree, navigation.anatomy.insertion, position)
        tips = [None if each is None else each.tip for each in seen]
        nothing = ((np.nan, np.nan),) * devices
        encoders, load = (
            np.array([*(nothing if each is None else getattr(each, name) for each in seen), nothing])
            for name in ("devices", "load")
        )
        decisions = {
            "decided": np.array(control),
            "measured": np.array([(np.nan, np.nan) if tip is None else (tip.abscissa, tip.offset) for tip in tips]),
            "believed": where[:-1],
            "half_width": half_width[:-1],
        }
        about = {
            "target": asdict(navigation.target),
            "world": world.differences(),
            "reason": reason,
            "gives_up": gives_up,
            "exposures_s": (DECISION_PERIOD_S * np.flatnonzero(exposures)).tolist(),
            "asks_for_xray": [tip.asks for tip in believed[:-1]],
            "found": found,
        }
        return NavigationRecord(
            time_s=DECISION_PERIOD_S * np.arange(samples),
            inserted_length=proximal[..., 0],
            rotation=proximal[..., 1],
            encoders=encoders,
            load=load,
            tip_position=position,
            tip=tip,
            shape=shape,
            contact_force_max=force,
            exposed=exposures > 0,
            control=np.array([*control, np.zeros((devices, 2))]),
            measured=(*tips, None),
            believed=where if tells else None,
            astray_mm=astray_mm(tree, (branch, where[:, 0]), (tip.branch[:, 0], tip.abscissa[:, 0])),
            half_width=half_width if tells else None,
            asks=tuple(tip.asks for tip in believed),
            found=found,
            cycles=_made(robot, cycles, decisions, about) if cycles else None,
            success=reason == "reached",
            safe=bool(is_safe(force.max(), navigation.force_limit_n)),
            seconds=DECISION_PERIOD_S * periods,
            peak_force_n=float(force.max()),
            exposures=int(exposures.sum()),
            path_mm=float(np.linalg.norm(np.diff(position[:, 0], axis=0), axis=1).sum()),
            faults=self.faults,
            reason=reason,
            gives_up=gives_up,
        )


def _made(robot: SimulatedRobot, cycles: int, decisions: dict[str, np.ndarray], about: dict[str, Any]) -> Trajectory:
    columns = {name: np.repeat(values, cycles // len(values), axis=0)[None] for name, values in decisions.items()}
    columns |= {name: values[:, :cycles] for name, values in robot.measured.items()}
    return replace(robot.recorder.trajectory().samples(slice(cycles)), columns=columns, about=about)


_NOTHING = BelievedTip(abscissa=np.nan, offset=np.nan)
