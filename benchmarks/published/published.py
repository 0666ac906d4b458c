"""Simulated bench tests beside published ones: `bench_published`.

What an article does not state is drawn at random, so each of our figures has a spread. A test whose figure a device's
constants were computed from is a calibration and no prediction.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np

from benchmarks.published.straightening import (
    STIFFENS_OVER_MM,
    TISSUE_MPA,
    TORTUOSITY,
    WIRES_GPA,
    Straightened,
    draw_path,
    stiff_wire,
    straighten,
    tortuosity_index,
)
from benchmarks.published.three_point import SPAN_MM, flexural_modulus
from benchmarks.published.tubing import BORE_MM, LENGTH_MM, draw_tubing, push_through
from endopilot.devices.catheter import Catheter, read_catheter
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.device_files import list_wires
from endopilot.progress import progress
from endopilot.settings import Within, settings
from endopilot.simulation.tip_load import simulate_tip_load

Kind = Literal["prediction", "calibration", "sensitivity"]
HARRISON = "Harrison et al., J Endovasc Ther 18 (2011) 797-801"
ZOARSKI = "Zoarski, Mathis and Hebel, AJNR 19 (1998) 1571-1576"
TORTUOUS = "Iliac artery tortuosity index in Chinese patients, Ann Vasc Surg 2023, S0890-5096(23)00149-8"
SOFTEST_GPA = (9.5, 14.5)
"""Flexural moduli of Harrison's softest wires, GPa: the plain Amplatz wire and those called heavy duty."""
WIRE_ALONE_N = (0.0, 0.078)
"""Largest force on Zoarski's wire alone, N: less than 8 gf."""
REINFORCED_N = (0.088, 0.137)
"""Largest forces on Zoarski's four reinforced microcatheters, N: 9 to 14 gf."""
WALL_FRICTION = (0.04, 0.15)
"""Least and largest Coulomb coefficient of an uncoated steel wire on wet PTFE, assumed."""
COATED_FRICTION = (0.03, 0.10)
"""The same of a hydrophilic catheter on wet PTFE, assumed."""
BORE_FRICTION = (0.04, 0.10)
"""The same of a wire in a catheter's liner, assumed; the range that the catheters' files state."""
GENTLE_MM = (12.0, 20.0)
"""Radii of a gentler path's bends, mm, which show how much the assumed ones matter."""
TIP_BEND_DEG = (0.0, 45.0)
"""Least and largest bend of the wire's tip, degrees, assumed: the article does not say how it was shaped."""
DIAMETER_TOLERANCE_MM = 0.013
"""By how much a wire's measured diameter may differ from the nominal one, mm, assumed: half a thousandth of an inch."""
DEFLECTION_MM = (0.5, 2.0)
"""Least and largest deflection in the bending test, mm, assumed."""
POLYMER_MPA = 100.0
"""Modulus of a catheter without reinforcement, MPa, assumed as the shipped microcatheters' files do for tips."""


@settings
class PublishedConfig:
    """How often what is not stated is drawn."""

    draws: Annotated[int, Within(1, 10000)] = 40
    """Number of draws of what an article does not state, such as a path's coordinates."""
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0
    """Seed of the draws."""


@dataclass(frozen=True)
class Comparison:
    """A published figure and ours.

    Attributes:
        case: what was tested.
        source: article or catalogue.
        kind: whether ours is a prediction, the figure that the device's constants were computed from, or a prediction
            with another assumption than ours.
        unit: of the figures.
        published: least and largest published figure; None where the article gives none.
        ours: our figure in each draw.
        note: how many draws failed, if any.
    """

    case: str
    source: str
    kind: Kind
    unit: str
    published: tuple[float, float] | None
    ours: tuple[float, ...]
    note: str = ""

    def row(self) -> dict[str, Any]:
        """Return it as a line of the table.

        `ours` is the median, `ours_p5` and `ours_p95` are percentiles over the draws, and `share_within` is the share
        of draws within what was published. `verdict`: "agrees" where the median is within, "overlaps" where some of the
        middle 90 % are, else "disagrees"; None where nothing was published, and unless it is a prediction.
        """
        low, middle, high = (float(np.percentile(self.ours, q)) for q in (5, 50, 95))
        least, largest = self.published or (None, None)
        verdict, share = None, None
        if least is not None and largest is not None and self.kind != "calibration":
            share = float(np.mean([least <= value <= largest for value in self.ours]))
            if self.kind == "prediction":
                overlaps = low <= largest and high >= least
                verdict = "agrees" if least <= middle <= largest else "overlaps" if overlaps else "disagrees"
        return {
            "case": self.case,
            "kind": self.kind,
            "unit": self.unit,
            "published_least": least,
            "published_largest": largest,
            "ours": _rounded(middle),
            "ours_p5": _rounded(low),
            "ours_p95": _rounded(high),
            "share_within": None if share is None else round(share, 3),
            "verdict": verdict,
            "draws": len(self.ours),
            "note": self.note,
            "source": self.source,
        }


def bench_published(config: PublishedConfig = PublishedConfig()) -> list[dict[str, Any]]:
    """Simulate published bench tests of wires and catheters, and show our figures beside theirs.

    Returns:
        A row for each figure, as `Comparison.row` gives it.

    Raises:
        RuntimeError: the rod core did not converge in a test of one wire.
    """
    comparisons = [*bending(config), *tip_loads(), *tubing_pushes(config), *straightenings(config)]
    return [comparison.row() for comparison in comparisons]


def bending(config: PublishedConfig) -> list[Comparison]:
    """Bend the shipped 0.035 inch wire between supports, at places behind its taper.

    Harrison's eleven wires are sold as stiff, and none of them is shipped; the shipped wire is an ordinary one, so it
    should be no stiffer than the softest of them.
    """
    random = np.random.default_rng([config.seed, 0])
    device = read_wire("j-035")
    shaft_mm = device.abscissa_mm[-1] + SPAN_MM
    moduli = tuple(
        flexural_modulus(
            device,
            at_mm=random.uniform(shaft_mm, 10 * shaft_mm),
            deflection_mm=random.uniform(*DEFLECTION_MM),
            diameter_mm=device.diameter_mm + random.uniform(-1, 1) * DIAMETER_TOLERANCE_MM,
        )
        for _ in range(config.draws)
    )
    case = "three-point bending: j-035, beside the softest stiff wires of 0.035 inch"
    return [Comparison(case, HARRISON, "prediction", "GPa", SOFTEST_GPA, moduli)]


def tip_loads() -> list[Comparison]:
    """Push the tip of each shipped wire whose catalogue states a tip load against a plate."""
    stated = [(device, device.tip_load_n) for device in map(read_wire, list_wires())]
    return [
        Comparison(
            f"tip load: {device.name}",
            device.sources["tip_load_n"],
            "calibration",
            "N",
            (load, load),
            (simulate_tip_load(device).load_n,),
        )
        for device, load in stated
        if load is not None
    ]


@dataclass(frozen=True)
class _Test:
    """A push through tubing: the devices, what was published, and which of our assumptions is another."""

    name: str
    wire: Wire
    catheters: tuple[Catheter, ...] = ()
    published: tuple[float, float] | None = None
    kind: Kind = "prediction"
    path: str = "assumed"
    smooth: bool = False


def tubing_tests() -> list[_Test]:
    """Return the pushes through tubing: those that were published, then some with another assumption."""
    soft, stiff = (read_wire(name) for name in ("workhorse-014", "stiff-014"))
    small, large = (read_catheter(name) for name in ("microcatheter-1.7f", "microcatheter-2.4f"))
    pair = f"{small.name} over {soft.name}"
    return [
        *(_Test(wire.name, wire, (), WIRE_ALONE_N) for wire in (soft, stiff)),
        *(
            _Test(f"{catheter.name} over {wire.name}", wire, (catheter,), REINFORCED_N)
            for catheter in (small, large)
            for wire in (soft, stiff)
        ),
        _Test(f"{large.name} without reinforcement over {soft.name}", soft, (unreinforced(large),)),
        *(
            _Test(f"{name}, {what}", soft, catheters, published, "sensitivity", path, smooth)
            for name, catheters, published in ((soft.name, (), WIRE_ALONE_N), (pair, (small,), REINFORCED_N))
            for what, path, smooth in (
                ("no friction on the wall", "assumed", True),
                (f"bends of {GENTLE_MM[0]:g} to {GENTLE_MM[1]:g} mm radius", "gentle", False),
                ("bends of half the angle", "half", False),
            )
        ),
    ]


def tubing_pushes(config: PublishedConfig) -> list[Comparison]:
    """Push wires and microcatheters through paths of tubing that are drawn at random.

    In each draw every device sees the same paths and the same friction.
    """
    tests = tubing_tests()
    forces: list[list[float]] = [[] for _ in tests]
    stuck, failed = [0] * len(tests), [0] * len(tests)
    with progress("Paths", total=config.draws) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # worlds that fail are counted
        for draw in range(config.draws):
            key = [config.seed, 1, draw]
            paths = {
                "assumed": draw_tubing(np.random.default_rng(key)).anatomy(),
                "gentle": draw_tubing(np.random.default_rng(key), radius_mm=GENTLE_MM).anatomy(),
                "half": draw_tubing(np.random.default_rng(key), angle_share=0.5).anatomy(),
            }
            drawn = _Drawn.draw(np.random.default_rng([*key, 1]))
            for place, test in enumerate(tests):
                devices = replace(drawn, wall=0.0, coated=0.0) if test.smooth else drawn
                catheters = [devices.catheter(each) for each in test.catheters]
                push = push_through(paths[test.path], devices.wire(test.wire), catheters)
                forces[place].append(push.force_n)
                failed[place] += not push.valid
                stuck[place] += push.valid and not push.through
            advance()
    case = f"pushed through {LENGTH_MM:g} mm of PTFE tubing of {BORE_MM:g} mm"
    return [
        Comparison(f"{case}: {test.name}", ZOARSKI, test.kind, "N", test.published, tuple(found), _note(held, lost))
        for test, found, held, lost in zip(tests, forces, stuck, failed, strict=True)
    ]


@dataclass(frozen=True)
class _Drawn:
    """What the article on tubing does not state of the devices."""

    wall: float
    coated: float
    bore: float
    tip_deg: float

    @staticmethod
    def draw(random: np.random.Generator) -> _Drawn:
        return _Drawn(
            *(random.uniform(*limits) for limits in (WALL_FRICTION, COATED_FRICTION, BORE_FRICTION, TIP_BEND_DEG))
        )

    def wire(self, device: Wire) -> Wire:
        return replace(device, friction=self.wall).shaped(self.tip_deg, device.tip_bend_length_mm)

    def catheter(self, catheter: Catheter) -> Catheter:
        return replace(catheter, friction=self.coated, bore_friction=self.bore)


def straightenings(config: PublishedConfig) -> list[Comparison]:
    """Push stiff wires through aorto-iliac paths in yielding tissue, all of which are drawn at random.

    No article was found that states a path and by how much a wire displaces it, so none of these figures is judged.

    Raises:
        RuntimeError: the rod core did not converge in any draw of a test.
    """
    softest, stiffest = min(WIRES_GPA, key=WIRES_GPA.__getitem__), max(WIRES_GPA, key=WIRES_GPA.__getitem__)
    beds: dict[str, dict[str, float]] = {
        f"tissue of {1000 * TISSUE_MPA[0]:g} kPa": {"tissue_mpa": TISSUE_MPA[0]},
        f"tissue of {1000 * TISSUE_MPA[1]:g} kPa": {"tissue_mpa": TISSUE_MPA[1]},
        f"tissue that stiffens over {STIFFENS_OVER_MM[0]:g} mm": {"stiffens_over_mm": STIFFENS_OVER_MM[0]},
        f"tissue that stiffens over {STIFFENS_OVER_MM[1]:g} mm": {"stiffens_over_mm": STIFFENS_OVER_MM[1]},
    }
    yielding: dict[str, list[Straightened]] = {name: [] for name in WIRES_GPA}
    rigid: dict[str, list[Straightened]] = {name: [] for name in (softest, stiffest)}
    other: dict[str, list[Straightened]] = {name: [] for name in beds}
    before: list[float] = []
    with progress("Iliac arteries", total=config.draws) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # worlds that fail are counted
        for draw in range(config.draws):
            path = draw_path(np.random.default_rng([config.seed, 2, draw]))
            before.append(tortuosity_index(path.iliac_mm))
            wires = {name: stiff_wire(modulus, friction=path.friction) for name, modulus in WIRES_GPA.items()}
            anatomy = path.anatomy()
            for name, wire in wires.items():
                yielding[name].append(straighten(path, anatomy, wire))
            for name, tests in rigid.items():
                tests.append(straighten(path, anatomy, wires[name], rigid=True))
            for name, changed in beds.items():
                bed = replace(path, **changed)
                at_its_scale = anatomy if bed.scale == path.scale else bed.anatomy()
                other[name].append(straighten(bed, at_its_scale, wires[stiffest]))
            advance()
    spread = (round(TORTUOSITY[0] - TORTUOSITY[1], 2), round(TORTUOSITY[0] + TORTUOSITY[1], 2))
    drawn = Comparison("tortuosity index of iliac arteries, drawn", TORTUOUS, "calibration", "", spread, tuple(before))
    rows = [_measured("no wire: tortuosity index", "tortuosity_before", "", yielding[softest])]
    rows += [row for name, tests in yielding.items() for row in _straightened(name, tests)]
    rows += _in_order(yielding)
    rows += [
        _measured(f"{name}, rigid wall: force of the wall", "force_n", "N", tests) for name, tests in rigid.items()
    ]
    changed = [
        _measured(f"{stiffest}, {name}: largest displacement", "largest_mm", "mm", tests, "sensitivity")
        for name, tests in other.items()
    ]
    return [*rows, *changed, drawn]


def _straightened(name: str, tests: list[Straightened]) -> list[Comparison]:
    quantities = (
        ("largest displacement", "largest_mm", "mm"),
        ("mean displacement", "mean_mm", "mm"),
        ("tortuosity index", "tortuosity", ""),
        ("force of the wall", "force_n", "N"),
    )
    return [_measured(f"{name}: {what}", quantity, unit, tests) for what, quantity, unit in quantities]


def _in_order(yielding: dict[str, list[Straightened]]) -> list[Comparison]:
    """Return by how much more each wire displaces a path than the next softer one, as a ratio."""
    rows: list[Comparison] = []
    for softer, stiffer in pairwise(yielding):
        pairs = zip(yielding[stiffer], yielding[softer], strict=True)
        ratios = tuple(more.largest_mm / less.largest_mm for more, less in pairs if more.valid and less.valid)
        case = f"aorto-iliac path, {stiffer} over {softer}: largest displacement"
        if ratios:
            rows.append(Comparison(case, HARRISON, "prediction", "", None, ratios))
    return rows


def _measured(case: str, quantity: str, unit: str, tests: list[Straightened], kind: Kind = "prediction") -> Comparison:
    """Return what was measured in the draws that converged, which no published figure can be held against."""
    figures = tuple(float(getattr(test, quantity)) for test in tests if test.valid)
    if not figures:
        raise RuntimeError(f"the aorto-iliac path with {case} did not converge in any draw")
    note = _note(sum(test.valid and not test.through for test in tests), sum(not test.valid for test in tests))
    return Comparison(f"aorto-iliac path, {case}", HARRISON, kind, unit, None, figures, note)


def unreinforced(catheter: Catheter) -> Catheter:
    """Return a catheter whose whole wall is plain polymer (`POLYMER_MPA`)."""
    bend = POLYMER_MPA * np.pi * (catheter.diameter_mm**4 - catheter.inner_diameter_mm**4) / 64
    ratio = catheter.twist_stiffness_n_mm2[0] / catheter.bend_stiffness_n_mm2[0]
    return replace(
        catheter, abscissa_mm=(0.0,), bend_stiffness_n_mm2=(float(bend),), twist_stiffness_n_mm2=(float(ratio * bend),)
    )


def _note(stuck: int, failed: int) -> str:
    counts = ((stuck, "did not pass"), (failed, "did not converge"))
    return ", ".join(f"{count} {what}" for count, what in counts if count)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
