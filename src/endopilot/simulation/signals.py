"""The signals of a trajectory, each declared once: `Outputs`, what the core records, and `SIGNALS`, all of them. A new
output of `_core.OUTPUTS` needs one more line here, its field in `Outputs`; one from elsewhere a row of `_FURTHER`, and
an array in `Trajectory.columns`."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from endopilot import _core
from endopilot.devices.stack import column_prefixes

_AXES = {"device": "worlds samples devices", "sample": "worlds samples", "node": "worlds samples nodes"}
UNIT_SUFFIXES = {"": "", "mm": "_mm", "rad": "_rad", "N": "_n", "N·mm": "_nmm"}
_PAIR = "worlds samples devices 2"
_TIP = ("tip_abscissa_mm", "tip_offset_mm")


class Signal(NamedTuple):
    """An array of a trajectory's file: its axes (apart by spaces; numbers are sizes), unit and meaning, and its columns
    in a table, one for each number of a sample; none if it has no place there."""

    axes: str
    unit: str
    meaning: str
    columns: tuple[str, ...] = ()

    @property
    def of_devices(self) -> bool:
        """Whether each device has an entry of its own."""
        return "devices" in self.axes


_FURTHER = {
    "start": Signal("worlds devices 2", "mm and rad", "inserted length and rotation before the first period"),
    "initial": Signal(
        "worlds devices 2", "mm and rad", "what devices were brought to before; NaN where worlds were on their way"
    ),
    "friction": Signal("worlds devices", "", "Coulomb coefficient on the wall"),
    "command": Signal(_PAIR, "mm/s and rad/s, or N and N·mm", "what the drives were asked for"),
    "control": Signal(
        _PAIR, "mm/s and rad/s", "what was made of it, mean over the period", ("translation_mm_s", "rotation_rad_s")
    ),
    "tip_abscissa": Signal(
        _AXES["device"], "mm", "Δtip, of the tip's projection, from the ostium along the centerline", _TIP[:1]
    ),
    "tip_offset": Signal(_AXES["device"], "mm", "γtip, of the tip from the centerline", _TIP[1:]),
    "tip_branch": Signal(_AXES["device"], "", "index of the branch that the tip lies in", ("branch",)),
    "tip_radius": Signal(_AXES["device"], "mm", "of the lumen at the tip's projection", ("lumen_radius_mm",)),
    "reason": Signal("worlds", "", "0 valid, 1 left the finite numbers, 2 did not converge, 3 went through the wall"),
    "vessel_to_laboratory": Signal("worlds samples 3 4", "", "affine map of the moving vessel's points, LPS mm"),
    "decided": Signal(
        _PAIR,
        "mm/s and rad/s",
        "what the policy decided, within the robot's limits",
        ("decided_translation_mm_s", "decided_rotation_rad_s"),
    ),
    "encoders": Signal(
        _PAIR,
        "mm and rad",
        "inserted length and rotation as the robot measured them",
        ("encoder_inserted_length_mm", "encoder_rotation_rad"),
    ),
    "load": Signal(
        _PAIR, "N and N·mm", "force and torque of the drive as the robot measured them", ("load_n", "load_nmm")
    ),
} | {
    name: Signal("worlds samples 2", "mm", meaning, tuple(f"{prefix}_{column}" for column in _TIP))
    for name, prefix, meaning in (
        ("measured", "measured", "Δtip and γtip as X-ray showed them when it was decided; NaN where it was off"),
        ("believed", "believed", "Δtip and γtip as the policy believed them then"),
        ("half_width", "band", "half-widths of the adviser's bands around them"),
        ("desired", "desired", "Δtip and γtip that the plan is to make"),
        ("predicted", "predicted", "Δtip and γtip that the plan's model predicts"),
    )
}
"""What the core does not record. A column holds for the periods of the drives' cycles in which it does not change."""


def _columns(name: str, of: str, numbers: int, unit: str) -> tuple[str, ...]:
    if of not in ("device", "sample"):
        return ()
    name = {"tip_position": "tip", "iterations": "newton_iterations"}.get(name, name)
    parts = [""] if numbers == 1 else [f"_{axis}" for axis in "xyz"]
    return tuple(name + part + UNIT_SUFFIXES[unit] for part in parts)


SIGNALS: dict[str, Signal] = _FURTHER | {
    name: Signal(_AXES[of] + (f" {numbers}" if numbers > 1 else ""), unit, meaning, _columns(name, of, numbers, unit))
    for name, of, numbers, unit, meaning in _core.OUTPUTS
    if of in _AXES
}
"""All signals by name: those of `Outputs`, the tip's projection, and what else a file may hold."""

_Class = TypeVar("_Class", bound=type)


def described(kind: _Class) -> _Class:
    """Complete the attributes of a class's docstring by the signals that it has and does not describe itself."""
    text = (kind.__doc__ or "").rstrip()
    text += "" if "Attributes:" in text else "\n\n    Attributes:"
    for name in (each.name for each in fields(kind) if each.name in SIGNALS and f"\n        {each.name}: " not in text):
        unit = SIGNALS[name].unit
        text += f"\n        {name}: {SIGNALS[name].meaning}{', ' if unit else ''}{unit}."
    kind.__doc__ = text + "\n    "
    return kind


@dataclass(frozen=True, eq=False, kw_only=True)
class Outputs:
    """What the core records of worlds at the ends of samples; devices count from the wire outwards."""

    inserted_length: Float[np.ndarray, "*each devices"]
    rotation: Float[np.ndarray, "*each devices"]
    tip_position: Float[np.ndarray, "*each devices 3"]
    tip_direction: Float[np.ndarray, "*each devices 3"]
    tip_twist: Float[np.ndarray, "*each devices"]
    base_force: Float[np.ndarray, "*each devices"]
    base_torque: Float[np.ndarray, "*each devices"]
    drive_force: Float[np.ndarray, "*each devices"]
    drive_torque: Float[np.ndarray, "*each devices"]
    slip: Float[np.ndarray, "*each devices"]
    rotation_slip: Float[np.ndarray, "*each devices"]
    contact_force_max: Float[np.ndarray, "*each"]
    contact_force_sum: Float[np.ndarray, "*each"]
    wall_force: Float[np.ndarray, "*each"]
    valid: Bool[np.ndarray, "*each"]


@described
@dataclass(frozen=True, eq=False, kw_only=True)
class Step(Outputs):
    """What all worlds did in one call of `Simulator.step`, with a row a world, and how hard it was to solve for, which
    data sets do without."""

    iterations: Float[np.ndarray, "*each"]
    node_iterations: Float[np.ndarray, "*each"]


def table_columns(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return signals as table columns by name, of catheters with their prefix; axes are rows, then devices."""
    of_devices = {name: each for name, each in values.items() if SIGNALS[name].of_devices}
    devices = next((each.shape[1] for each in of_devices.values()), 0)
    parts = [
        (prefix, {name: each[:, k] for name, each in of_devices.items()})
        for k, prefix in enumerate(column_prefixes(devices))
    ]
    parts.append(("", {name: each for name, each in values.items() if name not in of_devices}))
    return {
        prefix + column: each.reshape(len(each), -1)[:, i]
        for prefix, part in parts
        for name, each in part.items()
        for i, column in enumerate(SIGNALS[name].columns)
    }
