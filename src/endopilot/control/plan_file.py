"""A plan on disk: a folder of `trajectory.npz`, `manifest.json`, `plan.csv` and `plan.png`.

`trajectory.npz` is what is read back and driven again, to the bit: the plan's controls and what the rod core makes of
them, with the columns `desired` and `predicted`. `plan.csv` is for people and other programs: a row for the end of each
sample period of 0.5 s.

================================================  ====================================================================
column                                            meaning
================================================  ====================================================================
time_s                                            end of the period, s
translation_mm_s, rotation_rad_s                  control π over the period
inserted_length_mm, rotation_rad                  Δ and φ at its end
tip_abscissa_mm, tip_offset_mm, branch            where the rod core has the tip under these controls
lumen_radius_mm                                   lumen radius r there
tip_x_mm, tip_y_mm, tip_z_mm                      the tip in space, LPS
desired_tip_abscissa_mm, desired_tip_offset_mm    desired Δtip and γtip
predicted_tip_abscissa_mm, …_offset_mm            those that the method's model predicts
safety_ratio, contact_force_n                     γ/(r − r_w), largest wall force on one node
xray                                              1 where an exposure will be due at the end of the period, else 0
band_tip_abscissa_mm, band_tip_offset_mm          half-widths of the adviser's bands around the prediction
================================================  ====================================================================

The last two rows are there if the plan holds X-ray. A plan for wire and catheter also has columns `catheter_1_...`:
those from the translation to the tip in space, of the catheter.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from endopilot.anatomy.catheter_axis import with_axis
from endopilot.control.plan_config import Plan, PlanConfig
from endopilot.control.plan_xray import PlannedXray
from endopilot.control.set_up import tip_name
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import json_text, manifest, read_json, reading, sha256, writing_folder
from endopilot.settings import from_record
from endopilot.simulation.signals import table_columns
from endopilot.simulation.trajectory import TRAJECTORY, read_trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.types import Anatomy, TipProjection

_TABLE, _RECORD, PICTURE = "plan.csv", "manifest.json", "plan.png"


def write_plan(plan: Plan, *, output: str | Path, xray: PlannedXray | None = None) -> dict[str, Any]:
    """Write a plan as a folder, whole or not at all; a plan in it is replaced. Return its figures.

    Args:
        plan: the plan.
        output: the folder.
        xray: the X-ray that it will need, if that is known.

    Raises:
        InputError: the folder cannot be written, or holds something that is not a plan.
    """
    from endopilot.control.plan_picture import draw_plan  # matplotlib is slow to import

    folder = Path(output)
    navigation = plan.navigation
    figures = {
        "method": plan.config.method,
        "tip": tip_name(navigation.device),
        "why": plan.why,
        "catheter_tilt_deg": plan.tilt_deg,
        "reached": plan.reached,
        "within_force_limit": plan.within_force_limit,
        "seconds": plan.seconds,
        "target_mm": round(navigation.target.abscissa, 2),
        "tip_error_mm": round(float(np.abs(plan.arriving_tip.abscissa[-1] - navigation.target.abscissa)), 3),
        "model_error_mm": round(float(np.abs(plan.predicted[:, 0] - plan.tip.abscissa[:, 0]).mean()), 3),
        "peak_force_n": round(float(plan.force.max()), 4),
        "largest_safety_ratio": round(float(plan.ratio.max()), 3),
        "cost": {name: round(value, 3) for name, value in plan.cost_terms().items()},
        "seconds_to_plan": round(plan.seconds_to_plan, 2),
        "processor_seconds": round(plan.processor_seconds, 2),
    }
    if xray is not None:
        figures["xray_due_s"] = (DECISION_PERIOD_S * (1 + np.flatnonzero(xray.exposure))).tolist()
    with writing_folder(folder, _RECORD) as partial:
        _table(plan, xray).to_csv(partial / _TABLE, index=False)
        columns = {"desired": plan.desired[None], "predicted": plan.predicted[None]}
        about = {"target": asdict(navigation.target), "method": plan.config.method}
        about |= {"exposures_s": figures["xray_due_s"]} if xray is not None else {}
        replace(plan.trajectory, columns=columns, about=about).write(partial / TRAJECTORY)
        draw_plan(plan, partial / PICTURE, xray)
        record = manifest(
            config=plan.config,
            seed=plan.config.seed,
            inputs={},
            anatomy={"name": navigation.anatomy.name, "identity": navigation.anatomy.identity},
            device=asdict(navigation.device),
            **({"catheters": [asdict(each) for each in navigation.catheters]} if navigation.catheters else {}),
            catheter_axis=navigation.anatomy.insertion.direction.tolist() if plan.tilt_deg else None,
            model=plan.model,
            target=asdict(navigation.target),
            start={
                "inserted_length_mm": navigation.start_inserted_length_mm,
                "rotation_rad": navigation.start_rotation_rad,
            },
            limits={"seconds": navigation.seconds, "force_n": navigation.force_limit_n},
            trajectory_sha256=sha256(partial / TRAJECTORY),
            **figures,
        )
        (partial / _RECORD).write_text(json_text(record) + "\n", encoding="utf-8")
    return {"plan": str(folder), **figures}


def _table(plan: Plan, xray: PlannedXray | None) -> pd.DataFrame:
    """Return a row for the end of each sample period."""
    made = plan.trajectory
    signals = {
        "control": plan.control,
        **{name: getattr(made, name)[0] for name in ("inserted_length", "rotation", "tip_position")},
        **{f"tip_{name}": getattr(plan.tip, name) for name in TipProjection.__dataclass_fields__},
        "desired": plan.desired,
        "predicted": plan.predicted,
        **({} if xray is None else {"half_width": xray.half_width}),
    }
    return pd.DataFrame(
        {
            "time_s": DECISION_PERIOD_S * np.arange(1, len(plan.control) + 1),
            **table_columns(signals),
            "safety_ratio": plan.ratio,
            "contact_force_n": plan.force,
            **({} if xray is None else {"xray": xray.exposure.astype(int)}),
        }
    )


def read_plan(folder: Path, anatomy: Anatomy, stack: Stack | None = None) -> Plan:
    """Read a plan that `write_plan` wrote, for the anatomy that it was made for.

    The plan's own wire has the tip, and its anatomy the catheter's axis, that were chosen for it.

    Args:
        folder: of the plan.
        anatomy: the vessel.
        stack: devices that are to be those of the plan, but for the shape of the wire's tip; any will do if not given.

    Raises:
        InputError: a file is missing or damaged, or the plan is for another anatomy or device.
    """
    folder = Path(folder)
    with reading(folder, "plan anew"):
        return _plan_in(folder, anatomy, stack)


def _plan_in(folder: Path, anatomy: Anatomy, stack: Stack | None) -> Plan:
    record = read_json(folder / _RECORD)
    if not isinstance(record, dict) or "trajectory_sha256" not in record:
        raise InputError(f"{folder / _RECORD}: is not the manifest of a plan; make one with `endopilot plan`")
    try:
        config = from_record(PlanConfig, record["config"])
    except InputError as error:
        raise InputError(f"{folder / _RECORD}: config: {error}, or plan anew") from None
    made = record["anatomy"]
    if record["catheter_axis"] is not None:
        anatomy = with_axis(anatomy, np.array(record["catheter_axis"]))
    if made.get("identity") != anatomy.identity:
        raise InputError(
            f"{folder}: the plan is for another anatomy ({made['name']}), not for this {anatomy.name}; plan anew"
        )
    planned = from_record(Wire, record["device"])
    tip = {"tip_bend_rad": planned.tip_bend_rad, "tip_bend_length_mm": planned.tip_bend_length_mm}
    around = tuple(from_record(Catheter, catheter) for catheter in record.get("catheters", ()))
    made_for = Stack(planned, around)
    given = made_for if stack is None else replace(stack, wire=replace(stack.wire, **tip))
    if made_for.constants != given.constants:
        raise InputError(
            f"{folder}: the plan is for another device ({made_for.name}), not for {given.name}; plan anew, or give "
            "the plan's"
        )
    path = folder / TRAJECTORY
    if not path.exists() or sha256(path) != record["trajectory_sha256"]:
        raise InputError(f"{path}: is missing or differs from what {_RECORD} records; plan anew")
    trajectory = read_trajectory(path, anatomy=anatomy)
    return Plan(
        navigation=Navigation(
            anatomy=anatomy,
            device=planned,
            target=Target(**record["target"]),
            catheters=around,
            arrives=config.arrives,
            start_inserted_length_mm=record["start"]["inserted_length_mm"],
            start_rotation_rad=record["start"]["rotation_rad"],
            seconds=record["limits"]["seconds"],
            force_limit_n=record["limits"]["force_n"],
        ),
        config=config,
        model=record["model"],
        trajectory=trajectory,
        desired=trajectory.columns["desired"][0],
        predicted=trajectory.columns["predicted"][0],
        reached=record["reached"],
        why=record["why"],
        tilt_deg=record["catheter_tilt_deg"],
        seconds_to_plan=record["seconds_to_plan"],
        processor_seconds=record["processor_seconds"],
    )
