"""`endopilot navigate`: anatomy and target -> a wire driven there in closed loop, and its page."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.control.navigate_patient import NavigatePatientConfig
from endopilot.pipeline.navigation import navigate_into


def command(
    anatomy: Positional[Existing],
    /,
    *,
    target: str,
    output: OutputFolder,
    config: NavigatePatientConfig = NavigatePatientConfig(),
) -> Figures:
    """Let a policy drive a wire to a place of a patient's vessel: simulated robot, X-ray only when the policy asks.

    The folder gets navigation.html (replay and course), navigation.csv, navigation.png, trajectory.npz for `endopilot
    simulate`, episode for `endopilot train`, and manifest.json. Whether the target was reached, or why not,
    is the first line that is printed; the exit code is 0 either way.

    Args:
        anatomy: folder made by `endopilot anatomy` or `endopilot atlas`.
        target: section label such as 4 or LAD, or point X,Y,Z in LPS mm (--target=-1.5,2,3 where it begins with a
            minus).
        output: folder of the results.
        config: policy, wire, limits, and how reality differs from what the policy is given.
    """
    return navigate_into(anatomy, target, output, config)
