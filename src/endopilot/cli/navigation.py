"""`endopilot difficulty` and `plan`: how hard a section is to reach, and controls that bring a wire there."""

from __future__ import annotations

from pathlib import Path

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Answer, Figures
from endopilot.control.difficulty import arch_type, assess_difficulty
from endopilot.control.plan import plan
from endopilot.control.plan_config import PlanConfig
from endopilot.control.plan_file import write_plan
from endopilot.control.plan_xray import plan_xray
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.models.config import WIRES, run_inputs
from endopilot.runs import Existing, OutputFolder, claiming


def difficulty_command(anatomy: Existing, /, *, target: tuple[str, ...] = (), device: str = "workhorse-014") -> Answer:
    """Say before a procedure how hard each section of a vessel is to reach with a wire alone, the easiest first.

    Exposures and seconds are those that the policy `agent` would take, with intervals of 80 %, by what the navigations
    of the ladder took. An aortic arch is told its type.

    Args:
        target: sections such as 4 or PDA, or points X,Y,Z in LPS mm; the middles of all sections if none is given.
    """
    patient = read_anatomy(anatomy)
    rows = assess_difficulty(patient, read_wire(device), places=target)
    said = [f"aortic arch of type {kind}"] if (kind := arch_type(patient.tree)) else []
    if beyond := ", ".join(row["section"] for row in rows if row["extrapolated"]):
        said += [f"extrapolated beyond the ladder's navigations: {beyond}"]
    return Answer(rows, [[_shown(row) for row in rows], *said])


def _shown(row: dict[str, float | str | None]) -> dict[str, str]:
    """Return a row with each expectation and its interval in one cell, and no more digits than mean something."""

    def cell(measure: str) -> str:
        values = [row[f"{measure}{end}"] for end in ("", "_from", "_to")]
        return "-" if None in values else "{:.0f} ({:.0f}–{:.0f})".format(*values)

    forms = {"section": "{}", "length_mm": "{:.0f}", "turning_deg": "{:.0f}", "forks": "{}"}
    forms |= {"bore_mm": "{:.2f}", "tip_reaches": "{:.0%}"}
    plain = {name: form.format(row[name]) for name, form in forms.items()}
    return plain | {measure: cell(measure) for measure in ("exposures", "seconds")}


def plan_command(
    anatomy: Existing,
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
    with claiming(output, "endopilot plan", anatomy=patient.identity, model=weights, **asked):
        found = plan(patient, target, device=stack, model=model, config=config)
        return write_plan(found, output=output, xray=plan_xray(found) if xray else None)
