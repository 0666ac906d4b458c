"""Draws the pictures of docs/imaging.md and prints the agreement with the network's mask of the real aorta."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endopilot.anatomy.atlas import AtlasConfig, synthesize_one
from endopilot.anatomy.phantom import PhantomConfig, make_phantom
from endopilot.imaging.grid import interpolate_like
from endopilot.imaging.picture import draw_overlay
from endopilot.imaging.sample import fetch_sample
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.types import Volume

IMAGES = Path(__file__).parents[1] / "images"
SEEDS = ((2.0, -143.0, 543.0), (2.0, -184.0, 657.0))


def main() -> None:
    """Segment the real aorta and one synthetic coronary tree, and draw both."""
    sample = fetch_sample("cta-thorax")
    volume = read_volume(sample)
    mask = segment(volume, SegmentConfig(method="aorta", seeds=SEEDS))
    reference = read_mask(sample.with_name("seg_aorta.nii.gz"))
    draw_overlay(
        volume, mask, IMAGES / "imaging-aorta.png", reference=reference, through=np.array([25.0, -110.0, 700.0])
    )
    given = reference.volume
    values = Volume(given.voxels.astype(np.float32), given.spacing_mm, given.origin_mm, given.direction)
    theirs, ours = interpolate_like(values, volume, outside=0.0) > 0.5, mask.volume.voxels
    missed, millilitres = theirs & ~ours, float(volume.spacing_mm.prod()) / 1000
    print(f"Dice {2 * (ours & theirs).sum() / (ours.sum() + theirs.sum()):.3f}")
    extra = (ours & ~theirs).sum() * millilitres
    print(f"ours inside theirs {(ours & theirs).sum() / ours.sum():.3f}, the rest {extra:.0f} ml")
    low = (volume.voxels[missed] < 130).mean()
    print(f"cut off {missed.sum() * millilitres:.0f} ml, of which below 130 HU {low:.2f}")
    patient = synthesize_one(AtlasConfig(seed=1003), 0)
    phantom = make_phantom(patient, PhantomConfig(), 1003)
    draw_overlay(phantom, segment(phantom, SegmentConfig()), IMAGES / "imaging-coronary.png")


if __name__ == "__main__":
    main()
