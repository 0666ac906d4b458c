"""Real patients' data through the commands; skipped where the data are not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command import run

DATA = Path(__file__).parents[3] / "shared" / "data"
CORONARIES = DATA / "coronary_centerlines"
CTA = DATA / "cta_thorax"
CONTROLS = Path(__file__).parents[2] / "docs" / "examples" / "up-the-aorta.csv"


@pytest.mark.skipif(not CORONARIES.exists(), reason="the real coronary centerlines are not here")
def test_real_coronary_centerlines_are_simulated_and_learnt_on(tmp_path, capsys):
    for vessel in ("rca", "lca"):
        run(capsys, "anatomy", CORONARIES / f"{vessel}_cl.vtp", "-o", tmp_path / vessel, "--vessel", vessel)
    simulated = run(capsys, "simulate", tmp_path / "rca", "-o", tmp_path / "rollout.parquet", "--seconds", "20")
    assert simulated["valid_worlds"] == simulated["worlds"] == 8
    assert simulated["deepest_tip_mm"] > 40
    table = pd.read_parquet(tmp_path / "rollout.parquet")
    assert np.isfinite(table.select_dtypes("number")).all(axis=None)
    # γ ≤ r − r_wire up to the wall's give and the difference between a circle and the union of spheres
    assert (table["tip_offset_mm"] < table["lumen_radius_mm"] + 0.5).mean() > 0.99

    both = (tmp_path / "rca", tmp_path / "lca")
    sizes = ("--sequences", "4", "--seconds", "20", "--anatomy-shares", "0.5", "0", "0.5")
    run(capsys, "dataset", *both, "-o", tmp_path / "data", *sizes)
    run(capsys, "train", tmp_path / "data", "-o", tmp_path / "run", "--epochs", "2", "--max-seconds", "4")
    figures = run(capsys, "evaluate", tmp_path / "run", "-o", tmp_path / "evaluation")
    assert set(figures["splits"]) >= {"test"}
    assert np.isfinite(figures["splits"]["test"]["tip"]["P4"]["abscissa"]["all"]["mae"])


@pytest.mark.skipif(not CTA.exists(), reason="the real CT angiogram is not here")
def test_a_j_wire_goes_up_the_aorta_of_a_real_cta(tmp_path, capsys):
    mask, seeds = tmp_path / "mask.nii.gz", ("2", "-143", "543", "2", "-184", "657")
    agreement = run(
        *(capsys, "segment", CTA / "cta_thorax_1p5mm.nii.gz", "--method", "aorta", "--seeds", *seeds, "-o", mask),
        *("--reference", CTA / "seg_aorta.nii.gz", "--picture", tmp_path / "mask.png"),
    )
    assert agreement["dice"] > 0.84
    assert agreement["share_inside_reference"] > 0.9
    assert (tmp_path / "mask.png").stat().st_size > 100_000
    run(capsys, "anatomy", mask, "-o", tmp_path / "aorta", "--vessel", "generic")
    wire = run(
        *(capsys, "simulate", tmp_path / "aorta", "-o", tmp_path / "wire.csv"),
        *("--device", "j-035", "--controls", CONTROLS),
    )
    # a neck of the dissected lumen stops the wire, it folds back, and the drive slips at its 2 N
    assert wire["valid_worlds"] == 1 and wire["slipped_worlds"] == 1
    table = pd.read_csv(tmp_path / "wire.csv")
    assert np.isfinite(table.select_dtypes("number")).all(axis=None)
    assert table["tip_z_mm"].max() > table["tip_z_mm"].iloc[0] + 40
    assert table["inserted_length_mm"].max() > 80
    assert 2.0 < table["base_force_n"].max() < 3.0
