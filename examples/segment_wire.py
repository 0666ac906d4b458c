"""Train a small U-Net that finds the wire in angiograms, and measure it in patients whom it has not seen.

    endopilot atlas --count 6 --seed 31 -o runs/angio-patients
    endopilot atlas --vessel lca --count 6 --seed 31 -o runs/angio-patients
    endopilot angiograms runs/angio-patients/* -o runs/angiograms --cines 4 --seconds 2
    python examples/segment_wire.py runs/angiograms

It takes frames at random from the split "train", and reports on the split "test": Dice of the wire's mask; how far the
middle of what was found lies from the wire's true axis; and how much of the axis was found. It needs PyTorch.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
import SimpleITK as sitk
import torch
from scipy.ndimage import distance_transform_edt
from skimage.morphology import skeletonize
from torch import nn
from torch.nn import functional

CROP, NEAR_PX, WIRE = 256, 3.0, 16  # the wire's bit in the masks


class UNet(nn.Module):
    """Four scales of two convolutions each, with skips."""

    def __init__(self, width: int = 12, depth: int = 4) -> None:
        super().__init__()
        widths = [width * 2**scale for scale in range(depth)]
        self.down = nn.ModuleList(block(a, b) for a, b in zip([1, *widths], widths, strict=False))
        self.up = nn.ModuleList(block(a + b, a) for a, b in itertools.pairwise(widths))
        self.out = nn.Conv2d(width, 1, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        skips = []
        for scale, layer in enumerate(self.down):
            image = layer(functional.max_pool2d(image, 2) if scale else image)
            skips.append(image)
        image = skips.pop()
        for layer in reversed(self.up):
            wide = functional.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)
            image = layer(torch.cat([skips.pop(), wide], dim=1))
        return self.out(image)[:, 0]


def block(a: int, b: int) -> nn.Sequential:
    layers = [nn.Conv2d(a, b, 3, padding=1), nn.GroupNorm(4, b), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(b, b, 3, padding=1), nn.GroupNorm(4, b), nn.ReLU())


def frames_of(data: Path, split: str) -> list[tuple[Path, int]]:
    """Return the cine and the number of each frame of a split that shows a wire."""
    coco = json.loads((data / "annotations" / f"{split}.json").read_text())
    wire = next(category["id"] for category in coco["categories"] if category["name"] == "wire")
    shown = {entry["image_id"] for entry in coco["annotations"] if entry["category_id"] == wire}
    return [(data / "cines" / image["cine"], image["frame"]) for image in coco["images"] if image["id"] in shown]


def read(cine: Path, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame, scaled, and the mask of its wire."""
    grey, masks = (
        sitk.GetArrayFromImage(sitk.ReadImage(str(cine / part / f"{frame:04d}.png"))) for part in ("frames", "masks")
    )
    return (grey.astype(np.float32) - 128) / 64, (masks & WIRE) > 0


def train(data: Path, steps: int, batch: int, seed: int) -> UNet:
    torch.manual_seed(seed)
    random, frames, net = np.random.default_rng(seed), frames_of(data, "train"), UNet()
    print(f"{len(frames)} frames to train on, {sum(p.numel() for p in net.parameters())} weights")
    optimiser = torch.optim.AdamW(net.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    for step in range(steps):
        chosen = [crop(*read(*frames[random.integers(len(frames))]), random) for _ in range(batch)]
        image, mask = (torch.from_numpy(np.stack(part).astype(np.float32)) for part in zip(*chosen, strict=True))
        logit = net(image[:, None])
        share = logit.sigmoid()
        dice = 1 - (2 * (share * mask).sum() + 1) / (share.sum() + mask.sum() + 1)
        loss = functional.binary_cross_entropy_with_logits(logit, mask) + dice
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 50 == 0:
            print(f"step {step}: loss {loss.item():.3f}", flush=True)
    return net


def crop(image: np.ndarray, mask: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a square around a random pixel of the wire, perhaps mirrored."""
    places = np.argwhere(mask)
    middle = places[random.integers(len(places))] + random.integers(-CROP // 3, CROP // 3, 2)
    row, column = np.clip(middle - CROP // 2, 0, np.array(image.shape) - CROP)
    flip = slice(None, None, -1 if random.random() < 0.5 else 1)
    window = slice(row, row + CROP), slice(column, column + CROP)
    return image[window][:, flip].copy(), mask[window][:, flip].copy()


@torch.no_grad()
def measure(net: UNet, data: Path, most: int) -> dict[str, float]:
    """Return means over frames of unseen patients."""
    frames = frames_of(data, "test")
    rows = []
    for cine, frame in frames[:: max(len(frames) // most, 1)]:
        image, mask = read(cine, frame)
        found = net(torch.from_numpy(image)[None, None])[0].numpy() > 0
        axis = np.load(cine / "truth.npz")["wire_px"][frame]
        axis = np.rint(axis[((axis >= 0) & (axis < len(image) - 1)).all(axis=1)]).astype(int)
        middle = np.zeros_like(mask)
        middle[axis[:, 1], axis[:, 0]] = True
        dice = 2 * (found & mask).sum() / max(found.sum() + mask.sum(), 1)
        line = skeletonize(found)
        if line.any():
            to_axis = distance_transform_edt(~skeletonize(mask))[line]
            covered = distance_transform_edt(~found)[middle] <= NEAR_PX
            rows.append((dice, np.median(to_axis), np.mean(to_axis > NEAR_PX), np.mean(covered)))
        else:
            rows.append((dice, np.nan, 0.0, 0.0))
    dice, apart, false, covered = np.nanmean(rows, axis=0)
    return {
        "frames": len(rows),
        "patients": len({cine.name.rpartition("-")[0] for cine, _ in frames}),
        "dice": round(float(dice), 3),
        "centerline_distance_px": round(float(apart), 2),
        "found_elsewhere_share": round(float(false), 3),
        "axis_found_share": round(float(covered), 3),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--frames", type=int, default=100, help="frames to measure on, at most")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(
        json.dumps(measure(train(given.data, given.steps, given.batch, given.seed), given.data, given.frames), indent=2)
    )
