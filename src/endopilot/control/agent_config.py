"""Settings of agents, and the calibrations of their ensembles: `AgentConfig`, `read_agent_calibration`."""

from __future__ import annotations

from dataclasses import field, replace
from pathlib import Path
from typing import Annotated

from endopilot.belief.bands import Calibration
from endopilot.belief.belief import BeliefConfig
from endopilot.belief.thought import Pace
from endopilot.control.drive import SearchConfig
from endopilot.errors import InputError
from endopilot.settings import Positive, Within, settings
from endopilot.tasks.navigation import Navigation, XrayKind
from endopilot.tasks.route import Route

CALIBRATIONS: dict[tuple[XrayKind, int], Path] = {
    ("assumed", 1): Path(__file__).parent,
    ("images", 1): Path(__file__).parent / "images",
    ("assumed", 2): Path(__file__).parent / "coaxial",
}
"""Where the calibrations of the agent's ensembles lie, by how exposures find the tip and by the number of devices."""


@settings
class AgentConfig:
    """Settings of an agent: search, belief, and when the plan or the wire counts as lost."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """The search for a course."""
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    """The simulated wires."""
    off_course_mm: Positive = 2.5
    """Another course is searched when the likeliest tip is this far along the centerline from where it should be, mm.
    """
    tries: Annotated[int, Within(1, 100)] = 20
    """Failed searches, one after another and each from where the last has led, after which the agent gives up."""
    losses: Annotated[int, Within(1, 100)] = 4
    """Times that the devices may be lost, after which the agent gives up: each time another belief was sought."""
    horizon_mm: Positive | None = None
    """A course may end when it leads this far on, mm, and is searched on from there; all the way if not given."""
    evaluations: Annotated[int, Within(1, 10**15)] = 300_000_000
    """Evaluations of nodes (Newton's iterations times active nodes) that a search may take, some 20 s of a core; it
    then ends with the course that it has."""
    decision_evaluations: Annotated[int, Within(1, 10**15)] = 6_000_000
    """Those that a decision waits for, some 0.4 s of a core. A longer search goes on at the next decisions; the devices
    follow the course as far as it is known, and rest then."""
    decision_s: Positive | None = None
    """Wall time that a decision waits for a search instead, s: the search goes on while the devices move. That is for
    real robots, since the bits of a navigation then hang on the machine's speed."""
    planning_s: Annotated[float, Within(0, 86_400, above_low=True)] | None = None
    """Time at work after which a search ends likewise, s: then its bits hang on the machine's speed."""
    most_exposures: Annotated[int, Within(1, 10**6)] = 40
    """Exposures that an agent which looks when its adviser asks may take; it gives up where it needs more."""

    @property
    def pace(self) -> Pace:
        """What a decision waits for."""
        return Pace(self.decision_evaluations, self.decision_s)

    @staticmethod
    def of(navigation: Navigation) -> AgentConfig:
        """Return the settings for a navigation by a wire alone, in a wide lumen or not, or by one in a catheter."""
        target = navigation.target.abscissa
        wide = Route.to(navigation.anatomy, navigation.target).is_wide(target)
        if not navigation.catheters:
            return IN_WIDE_LUMEN if wide else AgentConfig()
        if IN_CATHETER.search.speed_mm_s * navigation.seconds >= _WAYS * target:
            return IN_CATHETER
        fastest = min(device.max_velocity_mm_s for device in navigation.devices)
        hurried = HURRIED_IN_WIDE_LUMEN if wide else HURRIED
        speed = max(hurried.search.speed_mm_s, _WAYS * target / navigation.seconds)
        return replace(hurried, search=replace(hurried.search, speed_mm_s=min(speed, fastest)))


IN_WIDE_LUMEN = AgentConfig(
    belief=BeliefConfig(
        members=24,
        ostium_spread_mm=3.5,
        element_mm=1.25,
        time_step_s=0.1,
        lost_along_mm=6.0,
        lost_across_mm=2.5,
        lost_across_radii=0.3,
    ),
)
"""Settings of an agent of a wire alone on a route through a wide lumen, such as an aorta. The wire lies more freely in
it, and the place of the ostium is known less well; bends are wide, so that longer elements and steps do."""
IN_CATHETER = AgentConfig(
    search=SearchConfig(speed_mm_s=5.0),
    belief=BeliefConfig(
        members=4,
        stiffness_levels=1,
        element_mm=1.25,
        lost_along_mm=5.0,
        lost_across_mm=2.5,
        lost_across_radii=0.5,
    ),
    off_course_mm=3.0,
)
"""Settings of an agent of a wire in a catheter."""
_WAYS = 4.0
"""Wire and catheter move in turn if there is time for a way so many times as long as the route; else together, and so
fast that there is time for it."""
HURRIED = replace(
    IN_CATHETER,
    search=replace(IN_CATHETER.search, together=True, longest_s=10.0),
    belief=replace(IN_CATHETER.belief, copies=32),
    losses=20,
    horizon_mm=60.0,
    most_exposures=100,
)
"""Settings for a pair that moves together. Soft devices fold and snap on half a metre of route, and soon lie otherwise
than simulated: more exposures may be taken, courses are short, and motions are drawn anew after each failure."""
HURRIED_IN_WIDE_LUMEN = replace(HURRIED, belief=replace(HURRIED.belief, time_step_s=0.1), off_course_mm=10.0)
"""The same on a route through a wide lumen, where soft devices do not lie as simulated: what counts is how they come to
the next fork."""


def read_agent_calibration(xray: XrayKind, devices: int) -> Calibration:
    """Return the calibration of the agent's ensemble, or raise `InputError` where there is none.

    `xray` is how exposures find the tip, `devices` 1 for a wire alone, 2 with a catheter.
    """
    if (xray, devices) not in CALIBRATIONS:
        raise InputError(
            f"policy: the agent is not calibrated for xray: {xray} with {devices - 1} catheters; give a wire alone, or "
            "xray: assumed and one catheter"
        )
    return Calibration.read(CALIBRATIONS[xray, devices])
