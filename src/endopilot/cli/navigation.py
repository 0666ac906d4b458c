"""`endopilot plan` and `navigate`: a wire brought to a target."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.control.navigate import NavigateConfig
from endopilot.control.plan import plan
from endopilot.control.plan_config import PlanConfig
from endopilot.control.plan_file import write_plan
from endopilot.control.plan_xray import plan_xray
from endopilot.devices.stack import Stack
from endopilot.models.config import WIRES, run_inputs
from endopilot.pipeline.navigation import navigate_into
from endopilot.runs import claiming


def plan_command(
    anatomy: Positional[Existing],
    /,
    *,
    target: str,
    output: OutputFolder,
    model: Path | None = None,
    device: str | None = None,
    catheter: tuple[str, ...] = (),
    xray: bool = False,
    config: PlanConfig = PlanConfig(),
) -> Figures:
    """Plan a navigation to a target.

    Args:
        target: section label such as 4 or PDA, point X,Y,Z in LPS mm, or CSV of desired tips (time_s, tip_abscissa_mm,
            tip_offset_mm).
        output: folder of plan.csv, plan.png and manifest.json.
        model: folder made by `endopilot train`, for the method inverse; the simulated wires, named `wires`, if not
            given.
        device: name of a device (`endopilot devices`) or a YAML file; by default the model's device, or workhorse-014
            without a model.
        catheter: one around the wire, which is planned for too (method search): a name such as microcatheter-1.7f, or a
            YAML file.
        xray: also predict when X-ray will be needed, by the bands of the agent's simulated wires.
    """
    stack = Stack.of(device or "workhorse-014", *catheter) if device or catheter else None
    patient, asked = read_anatomy(anatomy), {"target": target, "device": stack, "config": config, "xray": xray}
    weights = run_inputs(model or WIRES)
    with claiming(output, "endopilot plan", anatomy=patient.identity, model=weights, **asked, version=__version__):
        found = plan(patient, target, device=stack, model=model, config=config)
        return write_plan(found, output=output, xray=plan_xray(found) if xray else None)


def navigate_command(
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
