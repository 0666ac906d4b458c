"""The policy that decides by a network what the agent searches for: `ClonedPolicy`.

It believes and sees as the agent does: simulated wires follow the encoders, weighted by X-ray, which is on when the
monitor asks for it. Before a fork a network says which side the tip should point to; the wire is turned there, pushed
past, and looked at. Where that fails, it is pulled back to before the fork, and the side that failed is avoided.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.belief.monitor import BelievedTip, Monitor
from endopilot.control.agent_config import AgentConfig, read_agent_calibration
from endopilot.control.repertoire import stand_off
from endopilot.control.turn_network import AZIMUTH, ForkView, TurnNetwork
from endopilot.errors import InputError
from endopilot.navigation.policy import Decision, Observation
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import ENTERED_MM, NEAR_MM, Route, check_passable

NETWORK = Path(__file__).parent / "turns.npz"
"""The network that comes with the package."""
_SPEED_MM_S, _TURN_RAD_S, _CREEP_MM_S = 10.0, np.pi, 1.0
_LEAST_STAND_OFF_MM = 4.0
"""A wire is turned this far before a fork, mm, or as far as its mouth is wide."""
_GOOD_SHARE = 0.9
"""A side that passes nearly as likely as the likeliest is taken where the tip points there already."""
_SMOOTH = 8.0
"""Concentration of the errors of a turn (von Mises): a side in the midst of others that pass is better than one at
their edge."""
_KERNEL = np.exp(_SMOOTH * (np.cos(AZIMUTH[:, None] - AZIMUTH) - 1))
_AVOIDS = 6.0
"""Concentration about a side that has failed."""
_OFF_MM = 3.0
"""A tip that is believed so far in a wrong branch does not come back, mm."""
_STALL_PERIODS, _STALL_MM, _STALL_SHARE = 6, 8.0, 0.2
"""A wire is caught that was pushed so far in so many periods, while its tip came forward by less than this share."""
_PRESSES_SHARE = 0.85
"""A simulated wire that presses with more than this share of the force limit is pulled back."""
_FURTHER_MM = 2.0
"""It is pulled back by so much more after each failure."""
_FAILURES = 10
"""Failures at one place after which the policy gives up."""
_TURNED_RAD = 0.1
"""A wire this near to where it was to be turned is there, rad."""
_TURNS = 3
"""A wire is turned as often at one place at most, since friction holds some of a turn back."""


class ClonedPolicy:
    """Turns the wire as a network says, and pushes; X-ray is on when the monitor asks for it."""

    def __init__(self, network: TurnNetwork | None = None) -> None:
        """Take the network by which the wire is turned, the package's own if not given."""
        self._network = network or TurnNetwork.read(NETWORK)

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires.

        Raises:
            InputError: there is a catheter, or the lumen is narrower than the wire on the route.
        """
        if navigation.catheters:
            raise InputError("policy: cloned drives a wire alone; leave the catheters out, or take the agent")
        self.navigation, self.route = navigation, Route.to(navigation.anatomy, navigation.target)
        check_passable(self.route, navigation.device)
        calibration = read_agent_calibration(navigation.xray, 1)
        self.monitor = Monitor(navigation, calibration, config=AgentConfig.of(navigation).belief)
        self._believed = BelievedTip(np.nan, np.nan)
        self._at, self._turns, self._shows = -1, 0, False
        self._failures: dict[int, list[float]] = {}
        self._turn_to: float | None = None
        self._back_to: float | None = None
        self._side = 0.0
        self._pushed = list[tuple[float, float]]()

    def decide(self, observation: Observation) -> Decision:
        """Turn, push or pull back, as the module describes."""
        monitor = self.monitor
        self._believed = monitor.step(observation.devices, observation.load, observation.tip)
        self._shows = False
        if len(self._failed) >= _FAILURES:
            return Decision(gives_up=f"no side that the tip points to leads past {self._place():.0f} mm")
        drives = monitor.belief.drives
        if monitor.lost:
            self._turn_to = self._back_to = None
            self._pushed, self._turns = [], 0
            speed, turn = -_SPEED_MM_S, 0.0
        else:
            speed, turn = self._wanted(observation)
        wanted = drives.at_rest.copy()
        wanted[0] += DECISION_PERIOD_S * np.array([speed, turn])
        made = drives.towards(wanted, np.array([np.inf, _TURN_RAD_S])).commands
        drives.sent(made)
        return Decision(made, expose=bool(self._believed.asks) or self._shows)

    def believed(self) -> BelievedTip:
        """Return where the likeliest wire has its tip, the bands around it, and why X-ray is asked for."""
        return replace(self._believed, asks=self._believed.asks or ("a manoeuvre is over" if self._shows else ""))

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the simulated wires, the likeliest first: nodes from the tip on, LPS mm."""
        return self.monitor.belief.wires

    def _wanted(self, observation: Observation) -> tuple[float, float]:
        """Return the wanted translation and rotation of the wire, mm/s and rad/s."""
        belief, route = self.monitor.belief, self.route
        tip = belief.likeliest_tip()
        progress, off = float(route.progress(tip)[0]), float(route.off_route(tip)[0])
        inserted, rotation = belief.drives.at_rest[0].tolist()
        if self._back_to is not None:
            if (progress > self._back_to or off > 0) and inserted > self.navigation.start_inserted_length_mm:
                return -_SPEED_MM_S, 0.0
            self._back_to, self._turns = None, 0
        if self._turn_to is not None:
            if abs(self._turn_to - rotation) > _TURNED_RAD:
                return 0.0, float(np.clip((self._turn_to - rotation) / DECISION_PERIOD_S, -_TURN_RAD_S, _TURN_RAD_S))
            self._turn_to = None
        at = int(np.argmax(np.append(route.waypoints[:-1] + ENTERED_MM > progress, True)))
        if at != self._at:
            self._shows = at > self._at >= 0
            self._at, self._turns, self._pushed = at, 0, []
        left = self.navigation.target.abscissa - (progress if off > 0 else float(tip.abscissa[0]))
        if self._is_last and off == 0 and abs(left) <= NEAR_MM:
            return self._arrive(observation)
        if self._fails(inserted, progress, off):
            return self._give_way(progress)
        ahead = self._place() - self._stand_off() - progress if not self._is_last else left
        before = not self._is_last and ahead > 0.5
        if not before and self._turns < _TURNS and self._choose(progress):
            return self._wanted(observation)
        limit = ahead if before or self._is_last else np.inf
        return float(np.clip(limit / DECISION_PERIOD_S, -_CREEP_MM_S, _SPEED_MM_S)), 0.0

    @property
    def _is_last(self) -> bool:
        """Whether no fork is left before the target."""
        return self._at == len(self.route.junctions)

    def _place(self) -> float:
        """Return the abscissa of the fork ahead, or of the target, mm."""
        route = self.route
        return route.target.abscissa if self._is_last else float(route.junctions[self._at])

    @property
    def _failed(self) -> list[float]:
        """Sides that have failed at the place ahead, rad."""
        return self._failures.get(self._at, [])

    def _stand_off(self) -> float:
        further = _FURTHER_MM * (len(self._failed) % 4)
        return stand_off(self.route, self._place(), _LEAST_STAND_OFF_MM) + further

    def _fails(self, inserted: float, progress: float, off: float) -> bool:
        """Return whether the push does not lead past the place."""
        self._pushed = [*self._pushed, (inserted, progress)][-_STALL_PERIODS - 1 :]
        (first_in, first), full = self._pushed[0], len(self._pushed) > _STALL_PERIODS
        pushed = inserted - first_in
        caught = full and pushed > _STALL_MM and progress - first < _STALL_SHARE * pushed
        belief = self.monitor.belief
        presses = belief.force[belief.best] > _PRESSES_SHARE * self.navigation.force_limit_n
        at_target = self._is_last and progress >= self.navigation.target.abscissa - NEAR_MM
        return bool(caught or off > (0.0 if at_target else _OFF_MM) or presses)

    def _give_way(self, progress: float) -> tuple[float, float]:
        """Note that a side has failed, and go back to before the place."""
        self._failures[self._at] = [*self._failed, self._side]
        self._pushed, self._turns, self._shows = [], 0, True
        fork = not self._is_last and self._place() - 2 * self._stand_off() < progress
        back_to = (self._place() if fork else progress) - self._stand_off()
        entered = self.route.waypoints[self._at - 1] + 2 * ENTERED_MM if self._at else 0.0
        self._back_to = max(back_to, min(entered, progress - 2 * ENTERED_MM))
        return -_SPEED_MM_S, 0.0

    def _choose(self, progress: float) -> bool:
        """Choose the side that the tip is to point to; return whether the wire is to be turned."""
        belief, route = self.monitor.belief, self.route
        nodes = belief.simulator.position[belief.best]
        place = min(progress + self._stand_off(), self._place()) if self._is_last else self._place()
        view = ForkView.of(route, place, nodes, self.navigation.device)
        likely = self._network.passes(view)
        likely = likely ** (1 / (1 + len(self._failed)))  # the oftener it has failed, the less the network is believed
        for side in self._failed:
            likely = likely * (1 - np.exp(_AVOIDS * (np.cos(AZIMUTH - side) - 1)))
        likely = _KERNEL @ likely / _KERNEL.sum(axis=1)
        now = int(np.argmin(np.abs(np.angle(np.exp(1j * (AZIMUTH - view.azimuth))))))
        best = now if likely[now] >= _GOOD_SHARE * likely.max() else int(np.argmax(likely))
        self._side, self._turns = view.azimuth, self._turns + 1
        if best == now:
            self._turns = _TURNS
            return False
        turn = float(np.angle(np.exp(1j * (AZIMUTH[best] - view.azimuth))))
        self._turn_to = float(belief.drives.at_rest[0, 1]) + turn
        return True

    def _arrive(self, observation: Observation) -> tuple[float, float]:
        """Look at a tip that should be at the target, and move it by what the image shows."""
        self._shows = True
        if observation.tip is None:
            return 0.0, 0.0
        left = (self.navigation.target.abscissa - observation.tip.abscissa) / DECISION_PERIOD_S
        return float(np.clip(left, -2.0, 2.0)), 0.0
