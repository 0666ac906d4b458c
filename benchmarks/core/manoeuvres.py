"""What `python -m benchmarks robustness` drives through an anatomy, and how: devices, pairs and kinds of controls."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.devices.catheter import list_catheters, read_catheter
from endopilot.devices.device import Device, read_wire
from endopilot.devices.device_files import list_wires
from endopilot.devices.drive_limits import within_travel
from endopilot.devices.stack import Stack
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

MANOEUVRES = ("within", "beyond", "against the end", "pulled out")
"""Rollout i of a chunk is of kind i modulo 4, or its wire is: a catheter's kinds shift against the wire's."""
BEYOND = 1.3
"""The last three kinds insert up to this multiple of the longest path."""
_PUSH_MM_S = 8.0
"""Speed of the push against the vessel's end, mm/s."""
_PULL_MM_S = 20.0
"""Speed at which a wire is pulled out, mm/s; below every device's limit."""
_PULL_AT = 0.6
"""Share of the rollout after which it is pulled out."""
_AGAIN_AT = 0.85
"""Share of the rollout after which a wire or a catheter of a pair is pushed in again."""
_PAIRS = 5
"""Pairs of wire and catheter that each anatomy is driven through with."""


def stacks_of(index: int, *, seed: int, catheters: bool) -> list[Stack]:
    """Return what is driven through an anatomy: each shipped wire, or random pairs of a wire and a catheter around it.

    Args:
        index: number of the anatomy.
        seed: key of the random pairs.
        catheters: whether there are catheters.
    """
    wires = [read_wire(name) for name in list_wires()]
    if not catheters:
        return [Stack(wire) for wire in wires]
    around = [read_catheter(name) for name in list_catheters()]
    pairs = [
        Stack(wire, (catheter,))
        for wire in wires
        for catheter in around
        if wire.diameter_mm < catheter.inner_diameter_mm
    ]
    drawn = np.random.default_rng([seed, index]).choice(len(pairs), _PAIRS, replace=False)
    return [pairs[pair] for pair in drawn]


def seed_of(index: int, *, seed: int) -> int:
    """Return the key of the controls in an anatomy.

    Args:
        index: number of the anatomy.
        seed: of the benchmark.
    """
    return int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0])


def robust_controls(
    anatomy: Anatomy, device: Device, *, rollouts: int, samples: int, seed: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n samples 2"]]:
    """Return initial states and controls of the four manoeuvres in turn; see `MANOEUVRES`.

    Args:
        anatomy: the vessel.
        device: the wire, whose limits are kept.
        rollouts: their number.
        samples: sample periods of each.
        seed: key of the random streams.
    """
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    config = ControlConfig(
        max_velocity_mm_s=min(12.0, device.max_velocity_mm_s), max_rotation_rad_s=min(3.0, device.max_rotation_rad_s)
    )
    drawn = [
        random_controls(config, n_sequences=rollouts, n_samples=samples, seed=seed, max_inserted_length_mm=length)
        for length in (longest, BEYOND * longest)
    ]
    kind = np.arange(rollouts) % len(MANOEUVRES)
    pair = ((near[..., 0, :], far[..., 0, :]) for near, far in zip(*drawn, strict=True))
    initial, control = (np.where(_rows(kind == 0, near), near, far) for near, far in pair)
    turn = control[..., 1].copy()
    pull = round(_PULL_AT * samples)
    for rollout in np.flatnonzero(kind >= 2):
        if kind[rollout] == 2:
            control[rollout, :pull, 0] = _PUSH_MM_S
        control[rollout, pull:, 0] = -_PULL_MM_S
        inserted = initial[rollout, 0]
        for sample in control[rollout]:
            sample[0] = within_travel(sample[0], inserted, SAMPLE_PERIOD_S, travel_mm=(0.0, BEYOND * longest))
            inserted += SAMPLE_PERIOD_S * sample[0]
    control[..., 1] = turn
    return initial, control


def paired_controls(
    anatomy: Anatomy, stack: Stack, *, rollouts: int, samples: int, seed: int
) -> tuple[Float[np.ndarray, "n devices 2"], Float[np.ndarray, "n samples devices 2"]]:
    """Return `robust_controls` of a wire and of the catheters around it, side by side.

    With catheters, each has manoeuvres of its own, shifted against the wire's, and what was pulled out is pushed in
    again at the end.

    Args:
        anatomy: the vessel.
        stack: the devices, whose limits are kept.
        rollouts: their number.
        samples: sample periods of each.
        seed: key of the random streams.
    """
    drawn = [
        robust_controls(anatomy, device, rollouts=rollouts, samples=samples, seed=seed + drive)
        for drive, device in enumerate(stack.devices)
    ]
    if not stack.catheters:
        initial, control = drawn[0]
        return initial[:, None], control[:, :, None]
    rollout, again = np.arange(rollouts), round(_AGAIN_AT * samples)
    for drive, (initial, control) in enumerate(drawn):
        control[rollout % len(MANOEUVRES) >= 2, again:, 0] = _PUSH_MM_S
        group = rollout - rollout % len(MANOEUVRES)
        shifted = (group + (rollout + drive * group // len(MANOEUVRES)) % len(MANOEUVRES)) % rollouts
        initial[:], control[:] = initial[shifted], control[shifted]
    initial, control = (np.stack(parts, axis=-2) for parts in zip(*drawn, strict=True))
    return initial, control


def _rows(chosen: np.ndarray, like: np.ndarray) -> np.ndarray:
    return chosen.reshape(-1, *[1] * (like.ndim - 1))
