"""What a C-arm sees of a patient who moves: the wire where it is at that moment, less the motion that is known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.simulation.config import CoreMotion
from endopilot.simulation.motion import Motion, place, relative
from endopilot.simulation.simulator import Simulator


def seen(
    placed: Float[np.ndarray, "n 3 4"], known: CoreMotion | None, times_s: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3 4"]:
    """Return the affine maps by which the C-arm sees points of the moving vessel displaced, mm in the vessel of the CT.

    The vessel is truly placed so at these times, s; the C-arm takes the known motion off.
    """
    return placed if known is None else relative(placed, known.placements(times_s)[0])


def seen_wire(
    simulator: Simulator,
    known: Motion | None,
    ostium: Float[np.ndarray, "3"],
    time_s: float,
    registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return where a C-arm that takes known motion off sees the wire of one world, in the vessel as CT shows it.

    Returns:
        The nodes from the foremost tip on, the wire's tip, LPS mm, and the unit vector along the wire there.
    """
    nodes, tip, heading = simulator.position[0], simulator.tip_position[0, 0], simulator.tip_direction[0, 0]
    if any(registration_mm):
        nodes, tip = nodes + registration_mm, tip + registration_mm
    if simulator.set_up.motion is None:
        return nodes, tip, heading
    known_core = None if known is None else known.core(ostium)
    (maps,) = seen(simulator.vessel_to_laboratory[:1], known_core, np.array([time_s]))
    return place(maps, nodes), place(maps, tip), turned(maps, heading)


def seen_in_episodes(
    motion: Motion | None, known: Motion | None, ostium: Float[np.ndarray, "3"], samples: int, period_s: float
) -> Float[np.ndarray, "samples 3 4"] | None:
    """Return `seen` at each sample of a dataset's navigations in one patient; None if the patient lies still.

    Of the patient's own motion the C-arm takes off what is known, with the phase of heart and breath.
    """
    if motion is None:
        return None
    times_s = period_s * np.arange(1, samples + 1)
    placed = motion.core(ostium).placements(times_s)[0]
    return seen(placed, None if known is None else known.core(ostium), times_s)


def turned(
    maps: Float[np.ndarray, "*maps 3 4"], directions: Float[np.ndarray, "*directions 3"]
) -> Float[np.ndarray, "*turned 3"]:
    """Return the unit vectors along lines, of such directions, after affine maps; both are broadcast."""
    along = (maps[..., :3] @ directions[..., None])[..., 0]
    return along / np.linalg.norm(along, axis=-1, keepdims=True)
