"""Run inside DiffDRR's environment: `python diffdrr_rays.py SCENE.npz RAYS.npy` sums a volume along rays.

SCENE holds `volume` (x, y, z), attenuation of each voxel, 1/mm, its `edges_mm`, and in voxels the `source` and a
`target` for each ray; RAYS gets the line integrals, by Siddon's method (Med. Phys. 12:252, 1985).
"""

import sys

import numpy as np
import torch
from diffdrr.renderers import Siddon  # pyright: ignore[reportMissingImports]


def main(scene: str, rays: str) -> None:
    """Read a scene, cast its rays and write them."""
    held = np.load(scene)
    volume, source, target = (torch.tensor(held[name], dtype=torch.float64) for name in ("volume", "source", "target"))
    length = np.linalg.norm((held["target"] - held["source"]) * held["edges_mm"], axis=1)
    share = []
    for part in torch.split(target, 2000):
        share.append(Siddon()(volume, source[None, None], part[None], torch.ones(1, 1, len(part), dtype=torch.float64)))
    np.save(rays, torch.cat([each.reshape(-1) for each in share]).numpy() * length)


if __name__ == "__main__":
    main(*sys.argv[1:])
