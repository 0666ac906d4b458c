"""`endopilot difficulty`, `plan` and `advise`: how hard a place is to reach, controls that lead there, and when X-ray
is needed."""

from __future__ import annotations

from pathlib import Path

from endopilot.anatomy.io import read_anatomy
from endopilot.belief.advise import FIGURES_FILE, PICTURE_FILE, advise
from endopilot.belief.monitoring import AdviseConfig
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


def advise_command(
    run: Path,
    dataset: Existing,
    /,
    *,
    output: OutputFolder,
    also_test: tuple[Existing, ...] = (),
    config: AdviseConfig = AdviseConfig(),
) -> Answer:
    """Calibrate the X-ray adviser of a run, and measure on unseen patients which events it misses.

    The adviser asks for X-ray before the tip may be at the wall or far from where the model predicts it.

    Args:
        run: folder made by `endopilot train`; the calibration, xray.json, is written into it. Or `wires`,
            the simulated wires; the calibration is then written to the output.
        dataset: folder made by `endopilot dataset`, with at least 9 patients in its split 'calibrate'.
        output: folder of advice.json and advice.png.
        also_test: datasets that were made otherwise, with another wall or other elements: the same calibration is
            measured on their test patients too, which the bands must not have been fitted to.
    """
    found = advise(run, dataset, output, config, also_test=also_test)
    at, cover, left_out = found["adviser"], found["coverage"], found["patients_not_registered"]
    shown = {
        "figures": str(output / FIGURES_FILE),
        "picture": str(output / PICTURE_FILE),
        "level": found["calibration"].level,
        "coverage": cover["simultaneous"],
        "coverage_of_worst_decile_of_patients": cover["worst_decile_of_patients"],
        "missed_share": at["missed_share"],
        "exposures_per_minute": at["exposures_per_minute"],
        "share_of_the_exposures_of_periodic_imaging": found["share_of_the_exposures_of_periodic_imaging"],
        "fewer_frames_than_fluoroscopy": at["fewer_frames_than_fluoroscopy"],
        **({"patients_not_registered": ", ".join(left_out)} if left_out else {}),
        **{
            other["dataset"]: (
                f"coverage {other['coverage']['simultaneous']:.3f}, missed {other['adviser']['missed_share']:.3f}, "
                f"{other['adviser']['exposures_per_minute']:.1f} exposures a minute"
            )
            for other in found["made_otherwise"]
        },
    }
    return Answer(found, [shown])
