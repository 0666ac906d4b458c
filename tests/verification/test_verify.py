"""The rod core against closed forms and published scenes, and the commands that print them."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from benchmarks.__main__ import main as benchmarks
from benchmarks.verification import contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes
from benchmarks.verification import scenes as scenarios
from benchmarks.verification.transmission import LAG_RAD, turn
from benchmarks.verification.tubes import ELEMENTS, Uniform, drive, lay_out, mesh
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.cli import main
from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate
from endopilot.verification import free_rod
from endopilot.verification.free_rod import Case, Loading, compare

KEYS = ["case", "reference", "value", "error", "bar", "passed"]


def test_commands_print_rows_draw_figures_and_fail_where_a_bar_is_exceeded(monkeypatch, tmp_path, capsys) -> None:
    nothing = float("nan")
    skipped = Case("other engine", nothing, nothing, nothing, 0.02, skipped="it is not installed")
    found = [*free_rod.timoshenko(), skipped]
    for module in (contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes):
        monkeypatch.setattr(module, "CASES", ())
    monkeypatch.setattr(free_rod, "CASES", (lambda: found,))
    plots = ("--plots", str(tmp_path / "plots"))
    for code, further in ((0, []), (1, [compare("failed", 1.0, 1.1, 0.01)])):
        found += further
        for command, words in ((main, ("verify",)), (benchmarks, ("verification", *plots))):
            with pytest.raises(SystemExit) as left:
                command([*words, "--json"])
            assert left.value.code == code
            good, none, *bad = json.loads(capsys.readouterr().out)
            assert (
                list(good) == KEYS and [row["passed"] for row in (good, none, *bad)] == [True, None, False][: 2 + code]
            )
            assert none["case"] == "other engine (skipped: it is not installed)" and none["value"] is None
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"Timoshenko-tip.png", "failed.png"}


GROUPS = {
    f"{module.__name__.rsplit('.', 1)[-1]}.{group.__name__}": group
    for module in (free_rod, contact, motion, order, stability, transmission, tube, tubes, engine, kirchhoff)
    for group in module.CASES
}
LARGEST_BAR = 0.02
WIDER = {"tube.sinusoidal_buckling": 0.05, "tube.helical_buckling": 0.05, "order.order_in_element_length": 0.05}
WIDER |= {"kirchhoff.pushed_into_a_bend": 0.15, "kirchhoff.capstan": 0.05, "kirchhoff.helix_in_a_tube": 0.1}
WIDER |= {"order.order_in_navigation": 0.2, "order.order_in_time_step": 0.05, "motion.order_in_a_beating_heart": 0.2}


def turned_by(share: float, low: float, high: float) -> Callable[[Case], None]:
    """Return a check of the angle, rad, whose capstan a case compares with: T2/T1 = exp(µ θ)."""

    def check(case: Case) -> None:
        assert low < np.log(case.reference) / share < high

    return check


def friction_has_its_share(case: Case) -> None:
    work, elastic, _ = curves(case)
    assert work.y[-1] > 1.2 * elastic.y[-1] > 0


def errs_by_the_leading_term(case: Case) -> None:
    # c dδ/dt = F - 3 EI δ/L³: after one time constant implicit Euler errs by h/(2 e τ) of F L³/3EI
    error = curves(case)[1]
    assert abs(error.y * 2 * order.RELAXATION_S * (np.e - 1) / error.x - 1).max() < 0.1


def loses_its_stiffness(case: Case) -> None:
    # a ring's stiffness against cos 2θ falls towards its critical twist as 1 - (Tw/Tw_critical)²
    core = curves(case)[1]
    assert abs(core.y - (1 - (core.x / case.reference) ** 2)).max() < 0.01


def lies_as_winkler_says(case: Case) -> None:
    # along the whole rod: w = F β/(2k) exp(-β|x|) (cos βx + sin β|x|), β = (k/4EI)^¼ (Hetényi 1946)
    exact, core = curves(case)
    assert np.abs(core.y - exact.y).max() < 0.005 * exact.y.max()
    assert exact.y.min() < 0  # it lifts beside the load


def follows_or_whips(case: Case) -> None:
    # Far from θ = π the short wire's tip follows the closed form; the long one's jumps twice in a turn there and back.
    formula, short, _, long = curves(case)
    expected = np.interp(short.x, formula.x[np.argsort(formula.x)], np.sort(formula.y))
    assert np.abs(short.y - expected).max() < 0.05
    assert (np.abs(np.diff(long.y)) > 2.0).sum() == 2


SHOWN = {
    "contact.capstan": turned_by(0.4, 0.98 * np.pi / 2, np.pi / 2),
    "contact.capstan_over_bends": turned_by(0.3, np.pi - 0.97, np.pi - 0.93),  # a string cuts 0.95 rad off corners
    "contact.capstan_in_a_helix": turned_by(0.2, 2 * np.pi * 0.5**0.5 - 0.13, 2 * np.pi * 0.5**0.5 - 0.09),
    "motion.power_balance": friction_has_its_share,
    "order.order_in_time_step": errs_by_the_leading_term,
    "stability.michell_ring": loses_its_stiffness,
    "tube.compliant_wall": lies_as_winkler_says,
    "tube.torque_whip": follows_or_whips,
}
REFERENCES = {
    "free_rod.euler_column": np.pi**2 / 4,  # P = π² EI/(2L)² of a clamped-free column
    "stability.greenhill": 20.0,  # M = 2 √(EI T) (Greenhill 1883) with EI = 100 N mm², T = 1 N
    "tube.helical_buckling": 2 * np.sqrt(2) * tube.LOAD_N,  # Chen, Lin and Cheatham 1990
}


def curves(case: Case):
    assert case.picture is not None
    return case.picture.curves


@pytest.mark.parametrize("name", GROUPS)
def test_every_case_keeps_its_bar(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name.startswith("engine.") and importlib.util.find_spec("mujoco") is None:
        pytest.skip(engine.MISSING)
    if name == "kirchhoff.capstan":
        monkeypatch.setattr(kirchhoff, "LEAD_MM", 15.0)  # of 30 mm: half as much rod ahead of the bend
    cases = GROUPS[name]()
    assert cases
    for case in cases:
        assert case.error <= case.bar <= WIDER.get(name, LARGEST_BAR), case.case
    if name in REFERENCES:
        assert cases[0].reference == pytest.approx(REFERENCES[name])
    if name in SHOWN:
        SHOWN[name](cases[0])


def test_skipped_without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    rows = [case.row() for group in engine.CASES for case in group()]
    assert len(rows) == 3
    for row in rows:
        assert row["passed"] is None and row["value"] is None
        assert "MuJoCo is not installed" in row["case"]


def test_a_stiff_wire_is_dragged_more_than_a_string() -> None:
    string, wire = (scenarios.drag_through_bends(4, bend_n_mm2=stiffness) for stiffness in (0.1, 3.0))
    assert wire.wire_turning_rad == pytest.approx(string.wire_turning_rad, rel=0.1)
    assert wire.ratio > 1.2 * np.exp(0.2 * wire.wire_turning_rad)


def test_a_tip_sticks_at_ridges_and_slips_over_them() -> None:
    run = scenarios.stick_slip()
    later = run.pushed_mm > 12
    speed = np.diff(run.tip_mm)[later[1:]] / np.diff(run.pushed_mm)[later[1:]]
    assert np.mean(np.abs(speed) < 0.15) > 0.25  # it stands still again and again
    assert speed.max() > 2  # and leaps when it goes; this is a mean over half a second
    assert run.tip_mm[-1] == pytest.approx(run.pushed_mm[-1] - run.pushed_mm[0], rel=0.1)  # and gets there all the same
    # the leaps spend the energy that the pushing has stored: the force falls with each
    leaps = np.flatnonzero(later[1:] & (np.diff(run.tip_mm) > 2 * np.diff(run.pushed_mm)))
    assert len(leaps) >= 5
    assert (run.force_n[leaps + 1] < 0.8 * run.force_n[leaps]).all()


def test_a_long_curved_wire_whips() -> None:
    # L √(EI κ₀ κ_t / GJ) is 2.56, above π/2; `torque_whip` of the verification has a short one too
    whipping = scenarios.turn_in_a_bend(45.0, turns=0.75)
    jump = int(np.argmax(np.diff(whipping.tip_rad)))
    assert np.diff(whipping.tip_rad)[jump] > np.pi
    assert (whipping.drive_rad - whipping.tip_rad)[jump] > np.pi / 2
    # where it snaps the theory's curve folds back: no equilibrium beyond
    tip = np.linspace(0, np.pi, 100)
    drive, torque = scenarios.whip_theory(45.0, tip)
    assert whipping.drive_rad[jump] == pytest.approx(drive.max(), rel=0.04)
    assert whipping.torque_n_mm.max() == pytest.approx(torque.max(), rel=0.04)


def test_a_tip_buckles_on_a_plate_as_its_hold_allows() -> None:
    stiffness = read_wire("workhorse-014").bend_stiffness_n_mm2[0] / scenarios.PLATE_GAP_MM**2

    def load(friction: float, bend_deg: float) -> float:
        run = scenarios.push_against_a_plate(friction=friction, tip_bend_deg=bend_deg)
        return float(run.force_n[(run.pushed_mm > 0) & (run.pushed_mm < 0.5)].max())

    # π² EI/(4 L²) where the tip slides, 20.19 EI/L² where it sticks; the tip is bent by 1°, which takes 6 to 10 %
    assert load(0.0, 1.0) == pytest.approx(np.pi**2 / 4 * stiffness, rel=0.10)
    assert load(0.3, 1.0) == pytest.approx(20.19 * stiffness, rel=0.12)
    # a shaped tip buckles far below either
    assert load(0.1, 45.0) < 0.9 * np.pi**2 / 4 * stiffness
    # where it sticks and buckles, it slips in the end, and the force falls to the sliding one's
    run = scenarios.push_against_a_plate(friction=0.1, tip_bend_deg=1.0)
    assert run.force_n[run.pushed_mm > 1.0][0] < 0.2 * run.force_n.max()


def test_what_the_ostium_does_depends_on_the_path_alone() -> None:
    # rate independence: where the path of the drive is cut into more steps, it ends the same
    corners = np.array([0.0, 5.0, 1.5, 3.0, -4.0, 0.5])
    ends = []
    for steps in (1, 7, 40):
        legs = [np.linspace(a, b, steps + 1)[1:] for a, b in pairwise(corners)]
        rotation, torque = turn(np.concatenate(legs))
        ends.append([rotation[steps - 1 :: steps], torque[steps - 1 :: steps]])
    assert np.allclose(ends[0], ends[1], atol=1e-9) and np.allclose(ends[0], ends[2], atol=1e-9)


def test_a_small_loop_closes() -> None:
    # return-point memory: after a small loop the device goes on as if it had not been made
    whole = np.linspace(0.0, 0.9 * LAG_RAD, 10)
    loop = np.concatenate([whole[:6], whole[4:1:-1], whole[2:]])
    straight, looped = turn(whole[1:]), turn(loop[1:])
    assert looped[1][-1] == pytest.approx(straight[1][-1], abs=1e-12)
    assert looped[0][-1] == pytest.approx(straight[0][-1], abs=1e-12)


def test_closed_form_of_the_elastica() -> None:
    # elliptic integrals against Mattiasson's table: w/L and u/L by α = F L²/EI
    for alpha, tip in ((1.0, (0.301721, 0.056433)), (10.0, (0.810609, 0.554996))):
        assert free_rod.elastica_closed_form(alpha)[:2] == pytest.approx(tip, abs=1e-6)


@pytest.mark.parametrize("alpha", [1.0, 40.0])
def test_whole_elastica(alpha: float) -> None:
    # Not the tip alone: all nodes lie on the solution of θ'' = -α cos θ, θ(0) = 0, θ'(L) = 0.
    x, y = free_rod.elastica_curve(alpha)
    shape = free_rod.elastica_tip(alpha, 100)[1][:100]
    assert np.abs(np.interp(shape[::-1, 1], y, x) - shape[::-1, 0])[3:].max() < 1e-3


def test_the_push_balances_the_wall() -> None:
    # At rest and without friction the drive's push along the catheter's axis d and the wall's forces on the wire
    # cancel: push = -d · Σ k (r - φ) ∇φ over the contact points with φ < r, φ being the quadratic spline of the
    # distance map. They are the nodes and the middles of elements, where the wire's curve passes them.
    anatomy, device = make_patient(AtlasConfig(population="textbook"), 0), read_wire("workhorse-014")
    longest = float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=6, n_samples=24, seed=3, max_inserted_length_mm=longest
    )
    control[:, -4:] = 0.0  # at rest, where drag has gone
    config = SimulatorConfig(tolerance_mm=1e-7, wall_stiffness_n_mm=5.0, threads=1)
    rollout = simulate(
        anatomy, device, control, initial=initial, config=config, record_shape=True, friction=np.zeros(len(control))
    )
    assert rollout.valid.all() and rollout.shape is not None
    nodes, field = rollout.shape[:, -1].astype(float), anatomy.distance_map
    chord = nodes[:, :-1] - nodes[:, 1:]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    bend = (chord / length)[:, :-1] - (chord / length)[:, 1:]
    bend /= 0.5 * (length[:, :-1] + length[:, 1:])  # curvature vectors at the nodes
    bend = np.concatenate([bend[:, :1], bend, bend[:, -1:]], axis=1)
    middles = 0.5 * (nodes[:, :-1] + nodes[:, 1:]) - length**2 / 16 * (bend[:, :-1] + bend[:, 1:])
    points = np.concatenate([nodes, middles], axis=1)

    def distance(points: np.ndarray) -> np.ndarray:
        index = ((points - field.origin_mm) / field.spacing_mm)[..., ::-1]
        return map_coordinates(field.values.astype(float), np.moveaxis(index, -1, 0), order=2, mode="nearest")

    small = 1e-3 * np.eye(3)
    slope = np.stack([(distance(points + step) - distance(points - step)) / 2e-3 for step in small], axis=-1)
    depth = np.maximum(device.tip_radius_mm - distance(points), 0.0)
    behind = (nodes - anatomy.insertion.position) @ anatomy.insertion.direction
    held = (np.cumsum(behind[:, ::-1] > -3.0, axis=1) == 0)[:, ::-1]  # by the drive, in the catheter
    held = np.concatenate([held, held[:, 1:]], axis=1)  # the element that joins the base touches nothing
    pressed = np.where(held, 0.0, config.wall_stiffness_n_mm * depth)
    wall = (pressed[..., None] * slope).sum(axis=1) @ anatomy.insertion.direction
    push = rollout.base_force[:, -1, 0]
    assert np.abs(pressed.sum(axis=1) - rollout.contact_force_sum[:, -1]).max() < 0.05 * rollout.contact_force_sum.max()
    assert np.abs(push).max() > 5e-3
    assert np.abs(push + wall).max() < 0.01 * np.abs(push).max() + 1e-4, (push, wall)


def test_it_does_not_matter_which_tip_is_foremost() -> None:
    # The stack (wire ahead of catheter) and the stack with the same two tubes in each other's places are the same rod.
    first, second, length = Uniform(20.0, 16.0, 0.02), Uniform(60.0, 48.0, 0.01), 30.0
    rod, shapes = mesh(length), []
    for stack, inserted in (((first, second), (length, 17.0)), ((second, first), (17.0, length))):
        result = drive(rod, lay_out(stack, length), np.array(inserted))
        shapes.append(result["shape"][-1][:ELEMENTS])
    assert shapes[1] == pytest.approx(shapes[0], abs=1e-8)


def test_a_catheter_on_a_bent_wire_is_pushed_back() -> None:
    # Without friction, a mm more of a straight catheter over a wire that a moment M bends takes
    # M²/2 (1/EIw - 1/(EIw + EIc)) (D. Bigoni et al., Mechanics of Materials 80, 2015, have it for a rigid sleeve). At
    # the base it is bent itself, and T + EIc κ²/2 is the same all along a uniform tube.
    wire, catheter, length, covered, moment = Uniform(10.0, 8.0), Uniform(30.0, 24.0), 30.0, 16.0, 0.2
    rod = mesh(length, elements=240)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.moment_n_mm[0, 0] = moment
    result = drive(rod, lay_out((wire, catheter), length), np.array([length, covered]), loading=loading)
    both = wire.bend + catheter.bend
    expected = moment**2 / 2 * (1 / wire.bend - 1 / both) + catheter.bend * (moment / both) ** 2 / 2
    assert result["base_force"][-1, 1] == pytest.approx(expected, rel=0.02)
