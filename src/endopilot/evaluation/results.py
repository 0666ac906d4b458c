"""What an evaluation predicted, kept as arrays: everything that figures and tables are drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.errors import InputError
from endopilot.files import reading, regular, writing

METRICS_FILE, RESULTS_FILE, FIGURES_FOLDER, REPORT_FILE = "metrics.json", "evaluation.npz", "figures", "report.html"
"""What an evaluation writes into its folder."""

SPLITS: tuple[str, ...] = ("seen_test", "test")
"""Splits of a result: navigations of patients that the run was trained on, and of all other patients."""

SERIES_TITLES: Mapping[str, str] = {
    "P1": "Forward network, true controls (P1)",
    "P2": "Inverse network (P2)",
    "P3": "Inverse into forward network (P3)",
    "P4": "Controls of P3, simulated (P4)",
    "P4_replanned": "The same, planned anew at an X-ray image every 10 s",
    "P2_replayed": "Controls of P2, simulated",
    "hold_slack": "Baseline: hold slack and offset",
    "training_mean": "Baseline: training mean",
    "hold_control": "Baseline: hold the last control",
    "follow_slack": "Baseline: drive by the held slack",
    "true_replay": "True controls, simulated again",
    "friction_90": "True controls, simulated with 10 % less friction",
    "friction_110": "True controls, simulated with 10 % more friction",
}
"""What a reader calls each predicted series."""

TIP_BASELINES: Mapping[str, tuple[str, ...]] = {
    "P1": ("hold_slack", "training_mean"),
    "P3": ("hold_control", "follow_slack"),
    "P4": ("hold_control", "follow_slack"),
    "P4_replanned": ("hold_control", "follow_slack"),
    "P2_replayed": ("hold_control", "follow_slack"),
}
"""Baselines that stand beside each protocol's tip errors. Those of P1 know the true controls, as it does; those of P3
and P4 choose controls, which are then simulated."""

REPLAYED: Mapping[str, float] = {"true_replay": 1.0, "friction_90": 0.9, "friction_110": 1.1}
"""Series that simulate the true controls again, and the factor on friction of each."""

CONTROL_BASELINES: tuple[str, ...] = ("hold_control", "training_mean", "follow_slack")
"""Baselines that stand beside the inverse network's control errors (P2)."""


@dataclass(frozen=True, eq=False)
class TipSeries:
    """Where the tip was predicted to be after the given states; NaN where the prediction failed.

    Attributes:
        abscissa: Δtip, mm.
        offset: γtip, mm.
        radius: lumen radius where the tip was predicted to be, mm.
    """

    abscissa: Float[np.ndarray, "episodes samples"]
    offset: Float[np.ndarray, "episodes samples"]
    radius: Float[np.ndarray, "episodes samples"]


def tip_series(tip: Float[np.ndarray, "episodes samples 2"]) -> TipSeries:
    """Return a predicted (Δtip, γtip), mm, as a series; its radius is left NaN."""
    return TipSeries(tip[..., 0], tip[..., 1], np.full(tip.shape[:2], np.nan))


@dataclass(frozen=True, eq=False)
class SplitResult:
    """Everything predicted on one split, over the samples after the given states.

    Attributes:
        anatomy: index in `anatomies` of each episode.
        sequence: index of each episode among those of its anatomy.
        true_control: the recorded control, (mm/s, rad/s).
        tips: predicted tips by series (see `SERIES_TITLES`).
        controls: predicted controls by series, (mm/s, rad/s).
        base_force: axial force of the drive by simulated series, "true" being the recorded one, N.
        base_torque: torque of the drive likewise, N·mm.
        tip_distance: distance between the simulated and the recorded tip in space, by simulated series, mm.
        events: where the recorded tip sticks, slips or whips (see `metrics.tip_events`).
    """

    sample_period_s: float
    anatomies: tuple[str, ...]
    anatomy: Int[np.ndarray, "episodes"]
    sequence: Int[np.ndarray, "episodes"]
    wire_radius_mm: float
    true: TipSeries
    true_control: Float[np.ndarray, "episodes samples 2"]
    tips: Mapping[str, TipSeries]
    controls: Mapping[str, Float[np.ndarray, "episodes samples 2"]]
    base_force: Mapping[str, Float[np.ndarray, "episodes samples"]]
    base_torque: Mapping[str, Float[np.ndarray, "episodes samples"]]
    tip_distance: Mapping[str, Float[np.ndarray, "episodes samples"]]
    events: Mapping[str, Bool[np.ndarray, "episodes samples"]]

    @property
    def time_s(self) -> Float[np.ndarray, "samples"]:
        """Time of each sample after the last given state, s."""
        return (np.arange(self.true.abscissa.shape[1]) + 1) * self.sample_period_s

    def error(self, series: str, coordinate: str) -> Float[np.ndarray, "episodes samples"]:
        """Return predicted − true "abscissa" or "offset" of a series, mm; NaN where the prediction failed."""
        return getattr(self.tips[series], coordinate) - getattr(self.true, coordinate)

    def drive_difference(self, series: str, signal: str) -> Float[np.ndarray, "episodes samples"]:
        """Return simulated − recorded "force" (N) or "torque" (N·mm) of the drive; NaN where the simulation failed."""
        of = getattr(self, f"base_{signal}")
        return of[series] - of["true"]

    def lost(self, series: str) -> Bool[np.ndarray, "episodes samples"]:
        """Return where a series has no finite tip."""
        tip = self.tips[series]
        return ~(np.isfinite(tip.abscissa) & np.isfinite(tip.offset))


_MAPPINGS = ("controls", "base_force", "base_torque", "tip_distance", "events")
_TIP_FIELDS = ("abscissa", "offset", "radius")


def write_results(results: Mapping[str, SplitResult], path: Path) -> None:
    """Write the results of all splits as one .npz, keys "split/field" or "split/field/series", whole or not at all."""
    arrays: dict[str, np.ndarray] = {}
    for split, result in results.items():
        for name in ("sample_period_s", "anatomies", "anatomy", "sequence", "wire_radius_mm", "true_control"):
            arrays[f"{split}/{name}"] = np.asarray(getattr(result, name))
        for series, tip in {"true": result.true, **result.tips}.items():
            arrays |= {f"{split}/tips/{series}/{name}": getattr(tip, name) for name in _TIP_FIELDS}
        for name in _MAPPINGS:
            arrays |= {f"{split}/{name}/{series}": values for series, values in getattr(result, name).items()}
    with writing(path) as partial, partial.open("wb") as stream:
        # As keywords the keys would have to be identifiers for the type checker only; numpy takes any name.
        np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]


def read_results(path: Path) -> dict[str, SplitResult]:
    """Read what `write_results` wrote.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = regular(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file.items())
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; run `endopilot evaluate` first") from error
    except Exception as error:  # numpy raises many kinds on a damaged archive
        raise InputError(f"{path}: damaged ({error}); run `endopilot evaluate` again") from error
    with reading(path, "run `endopilot evaluate` again"):
        return {split: _read_split(arrays, split) for split in dict.fromkeys(key.split("/")[0] for key in arrays)}


def _read_split(arrays: Mapping[str, np.ndarray], split: str) -> SplitResult:
    def below(name: str) -> dict[str, np.ndarray]:
        prefix = f"{split}/{name}/"
        return {key.removeprefix(prefix): values for key, values in arrays.items() if key.startswith(prefix)}

    tip_arrays = below("tips")
    series = dict.fromkeys(key.split("/")[0] for key in tip_arrays)
    tips = {name: TipSeries(**{field: tip_arrays[f"{name}/{field}"] for field in _TIP_FIELDS}) for name in series}
    return SplitResult(
        sample_period_s=float(arrays[f"{split}/sample_period_s"]),
        anatomies=tuple(str(name) for name in arrays[f"{split}/anatomies"]),
        anatomy=arrays[f"{split}/anatomy"],
        sequence=arrays[f"{split}/sequence"],
        wire_radius_mm=float(arrays[f"{split}/wire_radius_mm"]),
        true=tips.pop("true"),
        true_control=arrays[f"{split}/true_control"],
        tips=tips,
        **{name: below(name) for name in _MAPPINGS},
    )
