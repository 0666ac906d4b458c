"""Real patients' data through the commands; skipped where the data are not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import binary_dilation

from command import run
from endopilot.imaging.volume import read_volume

DATA = Path(__file__).parents[3] / "shared" / "data"
CORONARIES = DATA / "coronary_centerlines"
CTA = DATA / "cta_thorax"


@pytest.mark.skipif(not CORONARIES.exists(), reason="the real coronary centerlines are not here")
def test_real_coronary_centerlines_are_simulated(tmp_path, capsys):
    run(capsys, "anatomy", CORONARIES / "rca_cl.vtp", "-o", tmp_path / "rca", "--vessel", "rca")
    simulated = run(capsys, "simulate", tmp_path / "rca", "-o", tmp_path / "rollout.parquet", "--seconds", "20")
    assert simulated["valid_worlds"] == simulated["worlds"] == 8
    assert simulated["deepest_tip_mm"] > 40
    table = pd.read_parquet(tmp_path / "rollout.parquet")
    assert np.isfinite(table.select_dtypes("number")).all(axis=None)
    # γ ≤ r − r_wire up to the wall's give and the difference between a circle and the union of spheres
    assert (table["tip_offset_mm"] < table["lumen_radius_mm"] + 0.5).mean() > 0.99


@pytest.mark.skipif(not CTA.exists(), reason="the real CT angiogram is not here")
def test_the_agent_drives_a_j_wire_over_the_arch_of_a_real_cta(tmp_path, capsys):
    mask, seeds = tmp_path / "mask.nii.gz", ("2", "-143", "543", "2", "-184", "657")
    agreement = run(
        *(capsys, "segment", CTA / "cta_thorax_1p5mm.nii.gz", "--method", "aorta", "--seeds", *seeds, "-o", mask),
        *("--reference", CTA / "seg_aorta.nii.gz", "--picture", tmp_path / "mask.png"),
    )
    assert agreement["dice"] > 0.84
    assert agreement["share_inside_reference"] > 0.92
    assert (tmp_path / "mask.png").stat().st_size > 100_000
    run(capsys, "anatomy", mask, "-o", tmp_path / "aorta", "--vessel", "generic")
    driven = run(
        *(capsys, "navigate", tmp_path / "aorta", "--target", "G6.1", "--device", "j-035"),
        *("--force-limit-n", "0.7", "-o", tmp_path / "navigation"),
    )
    assert driven["reached"] and driven["within_force_limit"] and driven["drive_slipped_s"] == 0
    table = pd.read_csv(tmp_path / "navigation" / "navigation.csv")
    assert table["tip_z_mm"].max() > 740  # the top of the arch, 200 mm above the place where the wire enters
    assert table["tip_z_mm"].iloc[-1] < 720 and table["tip_y_mm"].iloc[-1] < table["tip_y_mm"].iloc[0] - 30
    # it enters in the false lumen, and takes the true one, as a network sees them, where the two are apart
    place = table[["tip_x_mm", "tip_y_mm", "tip_z_mm"]].to_numpy()
    inside = [share_inside(CTA / f"seg_aorta_{name}_lumen.nii.gz", place) for name in ("false", "true")]
    depth = table["tip_abscissa_mm"].to_numpy()
    assert inside[0][depth < 15].all() and inside[1][(depth > 25) & (depth < 165)].all()


def share_inside(mask: Path, place: np.ndarray) -> np.ndarray:
    """Return which places, LPS mm, lie in a mask or within a voxel of it."""
    volume = read_volume(mask)
    grown = binary_dilation(volume.voxels > 0)
    i, j, k = np.round(volume.world_to_index(place)).astype(int).T
    return grown[k, j, i]
