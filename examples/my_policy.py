"""A policy of one's own: push, look once a second, and turn the wire where the tip took a wrong branch.

    python examples/my_policy.py
    cd examples && endopilot ladder --policy my_policy:TurnBack --tasks crux --patients 2

A policy has two methods. `start` gets the navigation: anatomy, device, target and limits. Every 0.5 s, `decide` gets
what the robot's encoders read and what X-ray shows. It answers with velocities and with whether it wants X-ray next.
"""

from __future__ import annotations

import math

import endopilot

PUSH_MM_S, PULL_MM_S, TURN_RAD_S = 5.0, -5.0, 3.0
BEFORE_FORK_MM = 4.0


class TurnBack:
    """Pushes; after a wrong branch it pulls back to before the fork, turns the wire by 120° and pushes again."""

    def start(self, navigation: endopilot.Navigation, seed: int) -> None:
        # Where each branch leaves the route to the target, mm from the ostium; infinite on the route itself.
        self.fork_mm = navigation.anatomy.tree.departures(navigation.target.branch)
        self.pull_to_mm: float | None = None
        self.turn_to_rad: float | None = None

    def decide(self, observation: endopilot.Observation) -> endopilot.Decision:
        tip, (inserted_length_mm, rotation_rad) = observation.tip, observation.devices[0]  # of the wire
        if tip is not None and math.isfinite(fork := float(self.fork_mm[tip.branch])):
            # The wire lies in a wrong branch: this much of it has to come out.
            self.pull_to_mm = inserted_length_mm - (tip.abscissa - fork) - BEFORE_FORK_MM
            self.turn_to_rad = rotation_rad + 2 * math.pi / 3
        if self.pull_to_mm is not None:
            if inserted_length_mm > max(self.pull_to_mm, 0.0):
                return endopilot.Decision(((PULL_MM_S, 0.0),))
            self.pull_to_mm = None
        if self.turn_to_rad is not None:
            if rotation_rad < self.turn_to_rad - 0.1:
                return endopilot.Decision(((0.0, min(TURN_RAD_S, 2 * (self.turn_to_rad - rotation_rad))),))
            self.turn_to_rad = None
        look = observation.time_s % 1.0 == 0.5
        return endopilot.Decision(((PUSH_MM_S, 0.0),), expose=look)


def main() -> None:
    # The second diagonal branch in the first of the ladder's patients, which pushing alone does not reach.
    navigation = endopilot.find_task("diagonal", version=1).ladder_navigation(0)
    policy = endopilot.make_policy("my_policy:TurnBack")  # as `endopilot ladder --policy` finds it
    record = endopilot.NavigationLoop(navigation, policy, seed=1).run()
    pushed = endopilot.NavigationLoop(navigation, endopilot.make_policy("forward"), seed=1).run()
    print(f"TurnBack: {record.reason} after {record.seconds:g} s and {record.exposures} exposures")
    print(f"forward: {pushed.reason}")
    assert record.success and record.safe and not pushed.success


if __name__ == "__main__":
    main()
