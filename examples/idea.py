"""The idea of endopilot on one page: believe in simulated wires, look when they disagree, drive what suits them all.

    python examples/idea.py

The tip of a guidewire is out of sight between two X-ray exposures. A dozen simulated wires stand for where it may be:
each has a friction and a tip of its own, and all make the motions that the robot's encoders read. An exposure says
which of them are like the real one. A search tries motions on all of them, and takes the one that brings most of their
weight into the right branch. X-ray is asked for when the wires no longer agree about the tip.

Everything here uses public names alone. `endopilot navigate` has the same five stages. What the agent adds are
calibrated bands, motions that free a caught wire, catheters, robots with play, patients who move, and images. This page
reached the targets of three of eight further patients (`lca` and `rca`, seeds 11 to 14). Read `Pilot.decide` first: the
stages are its lines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import endopilot

PERIOD_S = 0.5
"""Time from one decision to the next."""
WIRES = 12
COARSE = endopilot.SimulatorConfig(element_mm=1.25)
"""Simulated wires have coarser elements than the real one: it takes less time, and X-ray mends this error too."""
SPREAD = 0.2
"""Friction and tip bend of a real wire differ from its data sheet by up to this share."""
TURNED_RAD = 0.6
"""So much may lie between the turn of the drive and that of the tip when the wire goes in."""
TIP_ERROR_MM = 0.5
"""What X-ray measures of the tip along the vessel is off by this (standard deviation)."""
WIDEST_BAND_MM = 2.0
"""Look when nine tenths of the weight no longer lie within this length of vessel..."""
LONGEST_BLIND_S = 6.0
"""... or after this time: what no simulated wire can be is found by looking alone."""
PUSH_MM_S, TURN_RAD_S = 6.0, 3.0
LONGEST_PUSH_MM = 20.0
TRIED = 4
"""Motions are tried on the likeliest wires alone, which takes a third of the time."""
BEYOND_MM = 4.0
"""A tip this far past a fork, in the right branch, has taken it."""


@dataclass(frozen=True)
class Motion:
    """What the drive does for a while: pull back, turn, push on."""

    pull_mm: float
    turn_rad: float
    push_mm: float

    def controls(self) -> np.ndarray:
        """Return translation (mm/s) and rotation (rad/s) of each period: first all of the one, then of the next."""
        steps = [
            (-PUSH_MM_S, 0.0, self.pull_mm / PUSH_MM_S),
            (0.0, np.sign(self.turn_rad) * TURN_RAD_S, abs(self.turn_rad) / TURN_RAD_S),
            (PUSH_MM_S, 0.0, self.push_mm / PUSH_MM_S),
        ]
        rows = []
        for advance, turn, seconds in steps:
            if periods := round(seconds / PERIOD_S):
                share = seconds / (periods * PERIOD_S)  # so that whole periods make the whole motion
                rows += [(share * advance, share * turn)] * periods
        return np.array(rows).reshape(-1, 2)


class Pilot:
    """A policy: `start` gets the navigation, `decide` turns an observation into a decision, twice a second."""

    def start(self, navigation: endopilot.Navigation, seed: int) -> None:
        """Lay out the simulated wires where the real one begins."""
        self.navigation, self.tree = navigation, navigation.anatomy.tree
        self.leaves = self.tree.departures(navigation.target.branch)  # where each wrong branch leaves the route, mm
        self.random = np.random.default_rng(seed)
        factor = self.random.uniform(1 - SPREAD, 1 + SPREAD, (WIRES, 2))
        # Friction, the tip's bend and which way it points are what is known least of a wire.
        wire, turned = navigation.device, self.random.uniform(-TURNED_RAD, TURNED_RAD, WIRES)
        self.wires = [replace(wire, tip_bend_rad=wire.tip_bend_rad * bend) for bend in factor[:, 0]]
        self.turned = turned
        self.belief = endopilot.Simulator(navigation.anatomy, self.wires, config=COARSE)
        delta, phi = navigation.start[0]
        self.belief.reset(
            inserted_length=np.full(WIRES, delta), rotation=phi + turned, friction=wire.friction * factor[:, 1:]
        )
        self.weight = np.full(WIRES, 1.0 / WIRES)
        self.course: list[np.ndarray] = []
        self.seen_s, self.back_mm = 0.0, 0.0

    def decide(self, observation: endopilot.Observation) -> endopilot.Decision:
        """Predict, weigh, search, drive, ask."""
        self.predict(observation)
        if observation.tip is not None:
            self.seen_s = observation.time_s
            if self.weigh(observation.tip):
                self.course = []  # the best motion of a belief that was wrong is seldom the best now
        if not self.course:
            self.course = list(self.search().controls())
        control = self.course.pop(0) if self.course else np.zeros(2)
        advance, turn = map(float, control)
        return endopilot.Decision(((advance, turn),), expose=self.needs_xray(observation.time_s))

    def predict(self, observation: endopilot.Observation) -> None:
        """Drive all simulated wires as far as the encoders say that the real one was driven."""
        now = np.column_stack([self.belief.inserted_length[:, 0], self.belief.rotation[:, 0] - self.turned])
        moved = np.asarray(observation.devices[0]) - now
        if np.abs(moved).max() > 1e-6:
            self.belief.step(moved / PERIOD_S, PERIOD_S)

    def weigh(self, seen: endopilot.TipMeasurement) -> bool:
        """Give each wire the likelihood of the tip that X-ray shows (Bayes' rule); return whether that was news.

        A wire in another branch is not impossible: beside a fork, an error of the image may tell the wrong one. The
        logarithm is bounded for the same reason: what no wire explains leaves the weights as they were, nearly.
        """
        self.back_mm = max(0.0, float(seen.abscissa - self.leaves[seen.branch]))
        tip = self.belief.project()[:, 0]
        error = (tip.abscissa - seen.abscissa) / TIP_ERROR_MM
        logarithm = -0.5 * np.minimum(error**2, 50.0) - np.where(tip.branch == seen.branch, 0.0, 5.0)
        before = self.weight
        self.weight = before * np.exp(logarithm - logarithm.max())
        self.weight = 0.95 * self.weight / self.weight.sum() + 0.05 / WIRES  # none is lost: friction varies on the way
        return self.back_mm > 0.0 or 0.5 * float(np.abs(self.weight - before).sum()) > 0.5

    def search(self) -> Motion:
        """Try motions on the likeliest wires, and return the one that brings most of their weight farthest.

        Pulls and turns are all that a drive can change before a fork; pushing is what takes it. Time counts a little,
        so that far from a fork a plain push wins.
        """
        likeliest = np.argsort(-self.weight)[:TRIED]
        weight = self.weight[likeliest] / self.weight[likeliest].sum()
        turns = np.array([0.0, 0.8, -0.8, 1.6, -1.6, 2.4, -2.4, np.pi])
        push = min(self.distance_to_goal(), LONGEST_PUSH_MM)
        # Out of a wrong branch first, whatever the simulated wires say: the image was clear.
        pulls = (self.back_mm + BEYOND_MM,) if self.back_mm > 0.0 else (0.0, 2 * BEYOND_MM)
        motions = [Motion(pull, turn, pull + push) for pull in pulls for turn in turns]
        self.back_mm = 0.0
        wires = [self.wires[i] for i in likeliest]
        trials = endopilot.Simulator(self.navigation.anatomy, wires * len(motions), config=COARSE)
        trials.copy_worlds(np.tile(likeliest, len(motions)), of=self.belief)
        controls = [motion.controls() for motion in motions]
        longest = max(map(len, controls))
        filled = np.stack([np.pad(each, ((0, longest - len(each)), (0, 0))) for each in controls])
        filled = np.repeat(filled, TRIED, axis=0)
        filled[:, :, 0] = self.within_reach(trials.inserted_length[:, 0], filled[:, :, 0])
        began = self.progress(trials.project()[:, 0])
        made = trials.run(filled, period_s=PERIOD_S)
        gain = self.progress(made.tip[:, -1, 0]) - began
        force = np.where(made.valid, made.wall_force, np.inf).max(axis=1)
        gain = np.where(force > 0.8 * self.navigation.force_limit_n, -20.0, gain).reshape(len(motions), TRIED)
        seconds = np.array([PERIOD_S * len(each) for each in controls])
        return motions[int(np.argmax(gain @ weight - 0.2 * seconds))]

    def progress(self, tip: endopilot.TipProjection) -> np.ndarray:
        """Return how far along its way to the target each tip has come, mm: in a wrong branch, as far as the fork."""
        return np.minimum(np.minimum(tip.abscissa, self.leaves[tip.branch]), self.navigation.target.abscissa + 1.0)

    def distance_to_goal(self) -> float:
        """Return how far the next search pushes, mm: just past the next fork of the route, or to the target."""
        here = float(self.progress(self.belief.project()[:, 0]) @ self.weight)
        route = self.tree.route(self.navigation.target.branch)
        forks = np.array([self.tree.branches[b].centerline.abscissa[0] + BEYOND_MM for b in route[1:]])
        goals = np.append(forks[forks > here + 1.0], self.navigation.target.abscissa)
        return max(min(float(goals[0]), self.navigation.target.abscissa) - here, 1.0)

    def within_reach(self, inserted: np.ndarray, advance: np.ndarray) -> np.ndarray:
        """Return translations (mm/s) that neither pull a wire out nor push it farther than it is laid out."""
        ends = inserted[:, None] + PERIOD_S * np.cumsum(advance, axis=1)
        kept = np.clip(ends, 0.5, self.tree.longest_path().abscissa[-1] + 15.0)
        return np.diff(np.column_stack([inserted, kept]), axis=1) / PERIOD_S

    def needs_xray(self, now_s: float) -> bool:
        """Say whether to look at the end of the next period: the band of the tip is too wide, or blind for too long."""
        tip = self.belief.project()[:, 0]
        order = np.argsort(tip.abscissa)
        below = np.cumsum(self.weight[order])
        low, high = tip.abscissa[order][np.searchsorted(below, [0.05, 0.95]).clip(0, WIRES - 1)]
        astray = self.weight @ np.isfinite(self.leaves[tip.branch])
        near = abs(float(self.weight @ tip.abscissa) - self.navigation.target.abscissa) < 2 * PUSH_MM_S * PERIOD_S
        return bool(high - low > WIDEST_BAND_MM or astray > 0.05 or near or now_s - self.seen_s > LONGEST_BLIND_S)


def main() -> None:
    """Go far into a left coronary artery with a wire that is not the one on the data sheet."""
    patient = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="lca", seed=4)))
    branch = patient.tree.longest_leaf()
    goal = float(patient.tree.path(branch).abscissa[-1])
    target = endopilot.Target(branch=branch, abscissa=0.7 * goal)
    navigation = endopilot.Navigation(anatomy=patient, device=endopilot.read_wire("workhorse-014"), target=target)
    real = endopilot.World(friction_factor=1.15, tip_stiffness_factor=0.9)
    record = endopilot.NavigationLoop(navigation, Pilot(), seed=1, world=real).run()
    print(f"{record.reason}: {target.abscissa:.0f} mm in {record.seconds:g} s with {record.exposures} exposures")
    assert record.success and record.safe and record.exposures < record.seconds / PERIOD_S / 2


if __name__ == "__main__":
    main()
