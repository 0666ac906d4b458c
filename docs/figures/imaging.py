"""Draws the pictures of docs/evidence/imaging.md and prints the agreement with the network's mask of the real aorta."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.imaging.grid import compare_masks, mask_like
from endopilot.imaging.overlay_picture import draw_overlay
from endopilot.imaging.sample import fetch_sample
from endopilot.imaging.segment import SegmentConfig, segment
from endopilot.imaging.volume import read_mask, read_volume
from endopilot.phantom.phantom import PhantomConfig, make_phantom

IMAGES = Path(__file__).parents[1] / "images"
SEEDS = ((2.0, -143.0, 543.0), (2.0, -184.0, 657.0))


def main() -> None:
    """Segment the real aorta and one synthetic coronary tree, and draw both."""
    sample = fetch_sample("cta-thorax")
    volume = read_volume(sample)
    mask = segment(volume, config=SegmentConfig(method="aorta", seeds=SEEDS))
    reference = read_mask(sample.with_name("seg_aorta.nii.gz"))
    draw_overlay(
        volume, mask, IMAGES / "imaging-aorta.png", reference=reference, through=np.array([25.0, -110.0, 700.0])
    )
    theirs, ours = mask_like(reference, volume), mask.volume.voxels
    missed, zs = theirs & ~ours, np.flatnonzero((theirs & ~ours).sum(axis=(1, 2)) > 150)
    heights = [volume.index_to_world(np.array([0.0, 0.0, z]))[2] for z in (zs[0], zs[-1])]
    low = (volume.voxels[missed] < 130).mean()
    print(compare_masks(mask, reference))
    print(
        f"of what is cut off {low:.2f} is below 130 HU; most of it lies between z {heights[0]:.0f} and {heights[1]:.0f}"
    )
    patient = make_patient(AtlasConfig(seed=1003, population="textbook"), 0)
    phantom = make_phantom(patient, config=PhantomConfig(), seed=1003)
    draw_overlay(phantom, segment(phantom, config=SegmentConfig()), IMAGES / "imaging-coronary.png")


if __name__ == "__main__":
    main()
