"""Train what the tip detector knows of a wire in a pixel: `python -m benchmarks wire-evidence --write`.

A logistic regression on ridges, from images of synthetic patients whose wire is known. The patients are drawn with a
seed of their own; no patient that anything is measured on has it. It takes some 3 minutes on one core.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.optimize import minimize

from benchmarks.imaging.scenes import Scene, SceneConfig, draw_scenes
from endopilot.files import write_json
from endopilot.xray.absorbers import in_catheter, lumen_points
from endopilot.xray.detector import PARAMETERS, TipDetector, features, products

SCENES = SceneConfig(patients=8, seed=9001)
IMAGES, OFF_WIRE, STEP_MM = 10, 600, 0.25
DOSES, CONTRASTED_SHARE, FAR_PX, JITTER_PX = (0.25, 4.0), 0.3, 3.0, 0.35
RIDGE = 1e-4
"""Weight of the squared coefficients."""


def samples(scene: Scene, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the features of pixels on wires, and of pixels in the vessel off them."""
    detector = TipDetector(scene.anatomy, scene.device)
    places = lumen_points(scene.anatomy)[0]
    on, off = [], []
    for image in range(IMAGES):
        dose = float(np.exp(random.uniform(*np.log(DOSES))))
        contrast = float(random.uniform(0.3, 1.0)) if random.random() < CONTRASTED_SHARE else 0.0
        index = int(random.integers(len(scene.nodes)))
        signals = scene.signals(index, contrast=contrast, dose=dose, seed=1000 + image)
        nodes = in_catheter(scene.anatomy, scene.nodes[index])
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
        drawn = _resampled(nodes, along, np.arange(0.0, along[-1], 0.1))
        seen = _resampled(nodes, along, np.arange(0.1, scene.inserted_length[index] + 3.0, STEP_MM))
        for plane, signal in zip(scene.planes, signals, strict=True):
            plain = detector.without_contrast(plane.view, signal)
            found = features(plain, scene.imager.photons(plane, dose)).reshape(-1, *signal.shape)
            free = np.ones(signal.shape, dtype=bool)
            free[tuple(_inside(np.rint(plane.pixel(drawn)), signal.shape, 0).astype(int).T)] = False
            away = distance_transform_edt(free)
            jitter = random.uniform(-JITTER_PX, JITTER_PX, (len(seen), 2))
            wire = _inside(plane.pixel(seen) + jitter, signal.shape, 1)
            other = _inside(plane.pixel(places[random.integers(len(places), size=OFF_WIRE)]), signal.shape, 1)
            other = other[map_coordinates(away, other.T, order=1) > FAR_PX]
            for pixels, kept in ((wire, on), (other, off)):
                kept.append(np.stack([map_coordinates(part, pixels.T, order=1) for part in found], -1))
    return np.concatenate(on), np.concatenate(off)


def fit(on: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return weights, offset and cross-entropy of a logistic regression; wire and rest count the same."""
    terms = products(np.concatenate([on, off])).astype(float)
    label = np.concatenate([np.ones(len(on)), np.zeros(len(off))])
    weight = np.where(label > 0, 0.5 / len(on), 0.5 / len(off))
    scale = terms.std(axis=0)
    terms /= scale

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        logit = terms @ x[:-1] + x[-1]
        value = weight @ np.logaddexp(0, -logit * (2 * label - 1)) + RIDGE * x[:-1] @ x[:-1]
        slope = weight * (1 / (1 + np.exp(-logit)) - label)
        return float(value), np.append(terms.T @ slope + 2 * RIDGE * x[:-1], slope.sum())

    found = minimize(loss, np.zeros(terms.shape[1] + 1), jac=True, method="L-BFGS-B", options={"maxiter": 300})
    return found.x[:-1] / scale, float(found.x[-1]), float(found.fun)


def train_evidence(*, write: bool = False) -> dict[str, Any]:
    """Train what the tip detector knows of a wire in a pixel.

    Args:
        write: write the parameters into the package.

    Returns:
        What it was trained on, and the cross-entropy.
    """
    stream = np.random.default_rng(SCENES.seed)
    pairs = [samples(scene, stream) for scene in draw_scenes(SCENES)]
    on, off = (np.concatenate(part) for part in zip(*pairs, strict=True))
    weight, offset, entropy = fit(on, off)
    card = {
        "trained_by": "python -m benchmarks wire-evidence --write",
        "patients": SCENES.patients,
        "seed": SCENES.seed,
        "pixels_on_wires": len(on),
        "pixels_off_wires": len(off),
        "cross_entropy": round(entropy, 4),
    }
    if write:
        weights = [float(f"{value:.6g}") for value in weight]
        write_json(PARAMETERS, card | {"weight": weights, "offset": round(offset, 6)})
    return card


def _resampled(nodes: np.ndarray, along: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, along, part) for part in nodes.T], axis=-1)


def _inside(pixels: np.ndarray, shape: tuple[int, ...], margin: int) -> np.ndarray:
    return pixels[((pixels >= margin) & (pixels <= np.array(shape) - 1 - margin)).all(axis=1)]
