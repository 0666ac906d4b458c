"""Verification of the order of convergence: second in the length of the elements, first in the time step."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy
from endopilot.verification.free_rod import (
    Case,
    Curve,
    Loading,
    Picture,
    compare,
    elastica_tip,
    equilibrium,
    straight_rod,
)

ORDER_BAR = 0.05
"""Largest relative error of a measured order: 1.9 to 2.1, or 0.95 to 1.05, where the exact answer is known."""
NAVIGATION_BAR = 0.2
"""The same in a navigation, where stick and slip make the error uneven."""
ELEMENTS = np.array([20, 40, 80, 160])
RELAXATION_STEPS_S = 0.5 / np.array([10, 20, 40, 80])
RELAXATION_S = 0.5
NAVIGATION_STEPS_S = np.array([0.02, 0.01, 0.005])
NAVIGATION_FINEST_S = 0.000625
NAVIGATION_WORLDS = 4
NAVIGATION_SAMPLES = 20


def order_in_element_length() -> list[Case]:
    """Measure the order of the elastica's tip, w/L at α = 10, in the length of the elements.

    Strains are centred differences, so the error is C l² and falls by 3 C l²/4 when the elements are halved. That fall
    needs no reference; shear and stretch, which the elastica has not, drop out.
    """
    tip = np.array([elastica_tip(10.0, int(n))[0][0] for n in ELEMENTS])
    change = np.abs(np.diff(tip))
    return [
        order_case(
            "order in element length, elastica",
            2.0,
            1 / ELEMENTS[:-1],
            change,
            ("element length / L", "change of w/L when it is halved"),
            ORDER_BAR,
        )
    ]


def relaxation_error(step_s: float) -> float:
    """Return the relative error of a dragged tip's deflection one time constant after a load has come.

    A small force F on the tip of a cantilever whose tip alone has the drag c: c dδ/dt = F - 3 EI δ/L³, so δ(t) =
    F L³/(3 EI) (1 - exp(-t/τ)), τ = c L³/(3 EI).

    Args:
        step_s: time step; τ is RELAXATION_S.
    """
    rod = straight_rod(elements=200, length_mm=1.0, bend=1.0, twist=1.0)
    rod.drag_n_s_mm[0] = 3 * RELAXATION_S
    force = 3e-3
    loading = Loading.none(len(rod.abscissa_mm))
    loading.force_n[0, 1] = force
    config = SimulatorConfig(time_step_s=step_s, tolerance_mm=1e-9, threads=1)
    deflection = equilibrium(rod, loading, samples=1, config=config)["shape"][0][0, 1]
    return float(deflection / (force / 3 * (1 - np.exp(-1.0))) - 1)


def order_in_time_step() -> list[Case]:
    """Measure the order of the error of a dragged tip as the time step shrinks: implicit Euler is of first order."""
    error = np.array([abs(relaxation_error(step)) for step in RELAXATION_STEPS_S])
    return [
        order_case(
            "order in time step, relaxation",
            1.0,
            RELAXATION_STEPS_S,
            error,
            ("time step, s", "relative error"),
            ORDER_BAR,
        )
    ]


def order_in_navigation() -> list[Case]:
    """Measure the order of the tip's mean error in random navigations as the time step shrinks.

    The coronary wire goes through a synthetic right coronary artery for 10 s, pushed, pulled and turned at random.
    """
    initial, control = random_controls(
        ControlConfig(),
        n_sequences=NAVIGATION_WORLDS,
        n_samples=NAVIGATION_SAMPLES,
        seed=0,
        max_inserted_length_mm=float(patient().tree.longest_path().abscissa[-1]),
    )
    return [navigation_order("order in time step, navigation", initial, control)]


def patient() -> Anatomy:
    """Return the synthetic right coronary artery that navigations go through."""
    return make_patient(AtlasConfig(population="textbook"), 0)


def navigation_order(
    case: str,
    initial: Float[np.ndarray, "worlds 1 2"],
    control: Float[np.ndarray, "worlds samples 1 2"],
    motion: Motion | None = None,
) -> Case:
    """Return the order in time of the tip's mean distance (mm) from that at the finest time step.

    The error against a step h₀ that is not zero is proportional to h - h₀.

    Args:
        case: what is compared.
        initial: inserted length (mm) and rotation (rad) at the start.
        control: of the coronary wire in `patient`, mm/s and rad/s.
        motion: of the vessel.

    Raises:
        RuntimeError: a navigation did not converge.
    """
    anatomy, device = patient(), read_wire("workhorse-014")

    def tips(step_s: float) -> Float[np.ndarray, "worlds samples 3"]:
        config = SimulatorConfig(time_step_s=step_s, tolerance_mm=1e-6, threads=1)
        rollout = simulate(anatomy, device, control, initial=initial, config=config, motion=motion)
        if not rollout.valid.all():
            raise RuntimeError("a navigation of the verification did not converge")
        return rollout.tip_position[:, :, 0]

    finest = tips(NAVIGATION_FINEST_S)
    error = np.array([np.linalg.norm(tips(step) - finest, axis=-1).mean() for step in NAVIGATION_STEPS_S])
    names = (f"time step − {NAVIGATION_FINEST_S:g} s, s", "mean distance of the tips, mm")
    return order_case(case, 1.0, NAVIGATION_STEPS_S - NAVIGATION_FINEST_S, error, names, NAVIGATION_BAR)


def order_case(
    case: str,
    expected: float,
    size: Float[np.ndarray, "n"],
    error: Float[np.ndarray, "n"],
    names: tuple[str, str],
    bar: float,
) -> Case:
    """Return the comparison of the slope of errors over sizes, both on logarithmic scales, with the expected order.

    Args:
        case: what is compared.
        expected: the order.
        size: element lengths or time steps.
        error: at each of them.
        names: what size and error are, with units.
        bar: largest relative error of the order.
    """
    value = float(np.polyfit(np.log(size), np.log(error), 1)[0])
    ideal = error[-1] * (size / size[-1]) ** expected
    picture = Picture(
        *names,
        (Curve(f"order {expected:g}", size, ideal, "reference"), Curve("core", size, error)),
        logarithmic=True,
    )
    return compare(case, expected, value, bar, picture)


CASES = (order_in_element_length, order_in_time_step, order_in_navigation)
