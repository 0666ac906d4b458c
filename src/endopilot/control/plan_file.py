"""A plan on disk: a folder of `trajectory.npz`, `manifest.json`, `plan.csv` and `plan.png`.

`trajectory.npz` is what is read back and driven again, to the bit: the plan's controls and what the rod core makes of
them. `plan.csv` is for people and other programs: a row for the end of each
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
predicted_tip_abscissa_mm, …_offset_mm            Δtip and γtip that the method's model predicts
desired_tip_abscissa_mm, desired_tip_offset_mm    those that it was led along, if any
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
from endopilot.control.plan_config import Plan
from endopilot.control.plan_xray import PlannedXray
from endopilot.control.set_up import tip_name
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import json_text, manifest, read_json, reading, sha256, writing_folder
from endopilot.simulation.signals import table_columns
from endopilot.simulation.trajectory import TRAJECTORY, Trajectory, read_trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.types import Anatomy, TipProjection

_TABLE, _RECORD, PICTURE = "plan.csv", "manifest.json", "plan.png"


def write_plan(plan: Plan, *, output: str | Path, xray: PlannedXray | None = None) -> dict[str, Any]:
    """Write a plan as a folder, whole or not at all, with the X-ray that it will need if that is known; a plan in it is
    replaced, and something else refused (`InputError`). Return its figures.
    """
    from endopilot.control.plan_picture import draw_plan  # matplotlib is slow to import

    folder = Path(output)
    navigation = plan.navigation
    axis = navigation.anatomy.insertion.direction
    figures = {
        "method": plan.config.method,
        "tip": tip_name(navigation.device),
        "why": plan.choice.why if plan.choice else "",
        "catheter_tilt_deg": plan.choice.tilt_deg if plan.choice else 0.0,
        "reached": plan.reached,
        "within_force_limit": plan.within_force_limit,
        "seconds": plan.seconds,
        "target_mm": round(navigation.target.abscissa, 2),
        "tip_error_mm": round(abs(plan.end_mm - navigation.target.abscissa), 3),
        "model_error_mm": round(float(np.abs(plan.predicted[:, 0] - plan.tip.abscissa[:, 0]).mean()), 3),
        "peak_force_n": round(float(plan.force.max()), 4),
        "largest_safety_ratio": round(float(plan.ratio.max()), 3),
        "seconds_to_plan": round(plan.seconds_to_plan, 2),
    }
    if xray is not None:
        figures["xray_due_s"] = (DECISION_PERIOD_S * (1 + np.flatnonzero(xray.exposure))).tolist()
    with writing_folder(folder, _RECORD) as partial:
        _table(plan, xray).to_csv(partial / _TABLE, index=False)
        due = {"exposures_s": figures["xray_due_s"]} if xray is not None else {}
        about = plan.trajectory.about | {"method": plan.config.method} | due
        replace(plan.trajectory, about=about).write(partial / TRAJECTORY)
        draw_plan(plan, partial / PICTURE, xray)
        record = manifest(
            config=plan.config,
            seed=plan.config.seed,
            inputs={},
            anatomy={"name": navigation.anatomy.name, "identity": navigation.anatomy.identity},
            device=asdict(navigation.device),
            catheters=[asdict(each) for each in navigation.catheters],
            catheter_axis=axis.tolist() if figures["catheter_tilt_deg"] else None,
            model=plan.model,
            target=asdict(navigation.target),
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
        **{name: values[0] for name, values in made.columns.items()},
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


def read_plan(folder: Path, anatomy: Anatomy, stack: Stack | None = None) -> Trajectory:
    """Read the trajectory of a plan that `write_plan` wrote, for the anatomy that it was made for.

    Its own wire has the tip, and its anatomy the catheter's axis, that were chosen for it. InputError where a file is
    missing or damaged, or the plan is for another anatomy, or for others than these devices, tips apart.
    """
    path = folder / _RECORD
    with reading(path, "make one with `endopilot plan`"):
        record = read_json(path)
        axis, made, digest = record["catheter_axis"], record["anatomy"], record["trajectory_sha256"]
    if axis is not None:
        anatomy = with_axis(anatomy, np.array(axis))
    if made["identity"] != anatomy.identity:
        raise InputError(
            f"{folder}: the plan is for another anatomy ({made['name']}), not for this {anatomy.name}; plan anew"
        )
    path = folder / TRAJECTORY
    if not path.exists() or sha256(path) != digest:
        raise InputError(f"{path}: is missing or differs from what {_RECORD} records; plan anew")
    trajectory = read_trajectory(path, anatomy=anatomy)
    (own,) = trajectory.set_up.stacks
    tip = {name: getattr(own.wire, name) for name in ("tip_bend_rad", "tip_bend_length_mm")}
    if stack is not None and replace(stack, wire=replace(stack.wire, **tip)).constants != own.constants:
        raise InputError(
            f"{folder}: the plan is for another device ({own.name}), not for {stack.name}; plan anew, or give its own"
        )
    return trajectory
