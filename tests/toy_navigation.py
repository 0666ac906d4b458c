"""A wire with a closed form, for tests of what comes after the simulator.

The slack s = Δ − Δtip follows a play operator: it grows with insertion and shrinks with retraction, at the rate
`GRIP`, within an envelope that widens with depth. The offset is a function of depth and rotation.
"""

from __future__ import annotations

import numpy as np

from endopilot.types import SAMPLE_PERIOD_S, Anatomy, Rollout, TipProjection

GRIP = 0.6


def toy_simulate(anatomy: Anatomy, device, control, *, initial=None, config=None, friction=None) -> Rollout:
    """Return what the toy wire does under the controls; takes what `simulate` takes."""
    worlds, samples, _ = control.shape
    initial = np.zeros((worlds, 2)) if initial is None else initial
    proximal = initial[:, None] + SAMPLE_PERIOD_S * np.cumsum(control, axis=1)
    advance = np.diff(proximal[..., 0], axis=1, prepend=initial[:, :1])
    curliness = 0.02 + 0.005 * (len(anatomy.name) % 3)
    slack = np.zeros((worlds, samples))
    now = curliness * initial[:, 0]
    for t in range(samples):
        low = curliness * np.maximum(proximal[:, t, 0], 0)
        now = np.clip(now + GRIP * advance[:, t], low, low + 1.5)
        slack[:, t] = now
    abscissa = proximal[..., 0] - slack
    offset = 0.8 + 0.5 * np.sin(0.1 * abscissa + proximal[..., 1])
    direction = np.broadcast_to([1.0, 0.0, 0.0], (worlds, samples, 3)).copy()
    force = 0.01 * slack
    return Rollout(
        sample_period_s=SAMPLE_PERIOD_S,
        initial_inserted_length=initial[:, 0],
        initial_rotation=initial[:, 1],
        control=control,
        inserted_length=proximal[..., 0],
        rotation=proximal[..., 1],
        tip_position=np.stack([abscissa, offset, np.zeros_like(offset)], axis=-1),
        tip_direction=direction,
        tip=TipProjection(
            abscissa=abscissa,
            offset=offset,
            branch=np.zeros((worlds, samples), dtype=np.int64),
            radius=np.full((worlds, samples), 1.5),
        ),
        contact_force_max=force,
        contact_force_sum=2 * force,
        base_force=force,
        base_torque=0.1 * force,
        iterations=np.ones((worlds, samples)),
        valid=np.ones((worlds, samples), dtype=bool),
    )
