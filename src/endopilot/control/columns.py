"""The columns of a device that the tables of plans and of navigations share: `device_columns`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.stack import column_prefixes
from endopilot.types import TipProjection


def device_columns(
    device: int,
    control: Float[np.ndarray, "n 2"],
    proximal: Float[np.ndarray, "n 2"],
    tip: TipProjection,
    position: Float[np.ndarray, "n 3"],
) -> dict[str, Float[np.ndarray, "n"] | Int[np.ndarray, "n"]]:
    """Return what a device was commanded, how far it was inserted and turned, and where its tip was, by column.

    Args:
        device: 0 for the wire; for catheter 1 or 2, from the inside out, columns begin with `catheter_1_` or so.
        control: translation, mm/s, and rotation, rad/s.
        proximal: Δ, mm, and φ, rad.
        tip: Δtip, γtip, branch and lumen radius.
        position: of the tip, LPS mm.
    """
    columns = {
        "translation_mm_s": control[:, 0],
        "rotation_rad_s": control[:, 1],
        "inserted_length_mm": proximal[:, 0],
        "rotation_rad": proximal[:, 1],
        "tip_abscissa_mm": tip.abscissa,
        "tip_offset_mm": tip.offset,
        "branch": tip.branch,
        "lumen_radius_mm": tip.radius,
        **{f"tip_{axis}_mm": position[:, k] for k, axis in enumerate("xyz")},
    }
    prefix = column_prefixes(device + 1)[device]
    return {f"{prefix}{name}": values for name, values in columns.items()}
