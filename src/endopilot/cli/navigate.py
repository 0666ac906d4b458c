"""`endopilot navigate`: anatomy and target -> a wire driven there in closed loop, and its page."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.control.navigate import NavigateConfig
from endopilot.pipeline.navigation import navigate_into


def command(
    anatomy: Positional[Existing],
    /,
    *,
    target: str,
    output: OutputFolder,
    policy: str = "agent",
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    config: NavigateConfig = NavigateConfig(),
) -> Figures:
    """Let a policy drive a wire to a place of a patient's vessel: simulated robot, X-ray only when the policy asks.

    The folder gets navigation.html (replay and course), navigation.csv, navigation.png, trajectory.npz for `endopilot
    simulate`, episode for `endopilot train`, and manifest.json. Whether the target was reached, or why not,
    is the first line that is printed; the exit code is 0 either way.

    Args:
        output: folder of the results.
        policy: what decides: agent, cloned, oracle (which is given the truth), open-loop, forward, spin,
            retract-rotate, with a catheter in-turn or catheter-alone, or MODULE:OBJECT of your own.
    """
    return navigate_into(anatomy, target, output=output, policy=policy, device=device, catheter=catheter, config=config)
