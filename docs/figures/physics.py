"""Draw the pictures of docs/evidence/physics.md and print its figures: `python docs/figures/physics.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.verification import scenes as scenarios

mpl.use("Agg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).parents[1] / "images"


def draw_drag() -> None:
    """Draw the drag of a string and of two wires against the angle by which they turn."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", width_ratios=(1.25, 1))
    for stiffness, colour, name in ((0.1, "tab:blue", "string"), (1.0, "tab:orange", "wire"), (3.0, "tab:red", "wire")):
        runs = [scenarios.drag_through_bends(bends, bend_n_mm2=stiffness) for bends in range(7)]
        turning = np.rad2deg([run.wire_turning_rad for run in runs])
        ratio = np.array([run.ratio for run in runs])
        right.semilogy(turning, ratio, "o", color=colour, label=f"{name}, EI = {stiffness:g} N·mm²")
        print(f"drag, EI {stiffness:g}: turning {turning.round(1)}°, T2/T1 {ratio.round(3)}")
        print(f"      over exp(µθ): {(ratio / np.exp(0.2 * np.deg2rad(turning))).round(4)}")
        if stiffness == 0.1:
            last = runs[-1]
            left.plot(*last.axis_mm[::50, :2].T, color="0.85", linewidth=11, solid_capstyle="round")
            left.plot(*last.shape_mm[:, :2].T, color=colour, linewidth=1.3)
            left.annotate("0.1 N", last.shape_mm[0, :2], last.shape_mm[0, :2] + [-2, -7], color=colour)
            left.annotate("pulled back", last.shape_mm[-1, :2], (-19, 4), color=colour)
    angle = np.linspace(0, 260, 50)
    right.semilogy(angle, np.exp(0.2 * np.deg2rad(angle)), "k-", linewidth=1, label="exp(µθ), µ = 0.2")
    right.set(xlabel="angle θ by which the wire turns in all, °", ylabel="pull / load on the tip")
    right.set_yticks([1, 1.5, 2, 3, 4], labels=["1", "1.5", "2", "3", "4"])
    right.set_yticks([], minor=True)
    right.legend(fontsize=8)
    left.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title="six bends of 60°")
    figure.savefig(FOLDER / "physics-drag.png", dpi=90)


def draw_stick_slip() -> None:
    """Draw how tip and force go while a bent tip is pushed over ridges."""
    run = scenarios.stick_slip()
    axis, radius = scenarios.ridged_vessel()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", width_ratios=(1, 1.6))
    across = np.stack([-np.gradient(axis[:, 1]), np.gradient(axis[:, 0])], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    for side in (-1, 1):
        left.plot(*(axis[:, :2] + side * radius[:, None] * across).T, color="0.5", linewidth=1)
    speed = np.gradient(run.tip_mm, run.pushed_mm)
    slip = int(np.argmax(speed[:100]))
    for sample, colour, name in ((slip - 1, "tab:blue", "before"), (slip + 1, "tab:orange", "after")):
        left.plot(*run.shapes_mm[sample, :, :2].T, color=colour, linewidth=1.4, label=f"{name} the slip")
    tip = run.shapes_mm[slip, 0]
    left.set(
        aspect="equal", xlim=(tip[0] - 6, tip[0] + 6), ylim=(tip[1] - 14, tip[1] + 6), xlabel="x, mm", ylabel="y, mm"
    )
    left.legend(fontsize=8, loc="lower left")
    right.plot(run.pushed_mm, run.tip_mm, "tab:blue", label="tip")
    right.plot(run.pushed_mm, run.pushed_mm - run.pushed_mm[0], "k:", linewidth=1, label="drive")
    right.axvline(run.pushed_mm[slip], color="0.8", zorder=0, label="slip on the left")
    right.set(xlabel="advance of the drive, mm", ylabel="advance, mm")
    force = right.twinx()
    force.plot(run.pushed_mm, 1e3 * run.force_n, "tab:red", linewidth=1)
    force.set_ylabel("force of the drive, mN", color="tab:red")
    right.legend(loc="upper left", fontsize=8)
    figure.savefig(FOLDER / "physics-stick-slip.png", dpi=90)
    print(f"stick-slip: tip's speed over the drive's: median {np.median(speed):.2f}, largest {speed.max():.1f}")
    print(f"            force {1e3 * run.force_n.max():.0f} mN at most")


def draw_whip() -> None:
    """Draw the turn of the tip and the torque against the turn of the drive, with the theory's curves."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for curved, colour in ((20.0, "tab:blue"), (45.0, "tab:red")):
        run = scenarios.turn_in_a_bend(curved)
        tip = np.linspace(-1e-3, 4 * np.pi + 1e-3, 400)
        drive, torque = scenarios.whip_theory(curved, tip)
        number = curved * np.sqrt(scenarios.WHIP_BEND_N_MM2 / scenarios.WHIP_TWIST_N_MM2) / scenarios.CURVE_RADIUS_MM
        left.plot(np.rad2deg(drive), np.rad2deg(tip), "-", color=colour, alpha=0.4, linewidth=1)
        right.plot(np.rad2deg(drive), torque, "-", color=colour, alpha=0.4, linewidth=1)
        label = f"{curved:g} mm curved, number {number:.2f}"
        left.plot(np.rad2deg(run.drive_rad), np.rad2deg(run.tip_rad), ".", color=colour, markersize=4, label=label)
        right.plot(np.rad2deg(run.drive_rad), run.torque_n_mm, ".", color=colour, markersize=4)
        jump = int(np.argmax(np.abs(np.diff(run.tip_rad))))
        lag, leap = np.max(run.drive_rad - run.tip_rad), np.ptp(run.tip_rad[jump : jump + 2])
        fold = np.rad2deg(drive[tip < np.pi].max())
        print(f"whip, {curved:g} mm: largest lag {np.rad2deg(lag):.0f}°, leap within a sample {np.rad2deg(leap):.0f}°")
        print(f"      at {np.rad2deg(run.drive_rad[jump]):.0f}°; torque up to {run.torque_n_mm.max():.3f} N·mm")
        print(f"      theory: first fold at {fold:.0f}°, torque up to {torque.max():.3f} N·mm")
    left.plot([0, 810], [0, 810], "k:", linewidth=1, label="no lag")
    left.plot([], [], "-", color="0.6", label="theory, no clearance")
    left.set(xlim=(0, 810), ylim=(-20, 830), xlabel="turn of the drive, °", ylabel="turn of the tip, °")
    right.set(xlim=(0, 810), xlabel="turn of the drive, °", ylabel="torque of the drive, N·mm")
    left.legend(fontsize=8)
    figure.savefig(FOLDER / "physics-whip.png", dpi=90)


def draw_buckling() -> None:
    """Draw the force on a tip that is pushed against a plate, and the wire before and after."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", width_ratios=(1, 1.4))
    cases = ((0.0, 1.0, "tab:blue"), (0.1, 1.0, "tab:orange"), (0.3, 1.0, "tab:red"), (0.1, 45.0, "tab:green"))
    for friction, bend, colour in cases:
        run = scenarios.push_against_a_plate(friction=friction, tip_bend_deg=bend)
        shape = "straight" if bend < 5 else f"bent by {bend:g}°"
        right.semilogy(
            run.pushed_mm, np.maximum(1e3 * run.force_n, 1e-2), color=colour, label=f"{shape}, µ = {friction:g}"
        )
        sample = int(np.searchsorted(run.pushed_mm, 1.0))
        left.plot(*run.shapes_mm[sample, :, :2].T, color=colour, linewidth=1.3)
        first = run.force_n[(run.pushed_mm > 0) & (run.pushed_mm < 0.5)].max()
        print(f"plate, µ {friction:g}, bent {bend:g}°: {1e3 * first:.1f} mN within the first 0.5 mm")
    device = scenarios.read_wire("workhorse-014")
    stiffness = device.bend_stiffness_n_mm2[0] / scenarios.PLATE_GAP_MM**2
    for load, name in ((np.pi**2 / 4 * stiffness, "clamped-free"), (20.19 * stiffness, "clamped-pinned")):
        right.axhline(1e3 * load, color="0.6", linewidth=1, linestyle="--")
        right.text(3.65, 1.05e3 * load, f"{name}, {1e3 * load:.1f} mN", ha="right", fontsize=8, color="0.3")
    right.set(xlim=(-0.1, 3.7), ylim=(1, 110), xlabel="push after the first touch, mm", ylabel="force of the drive, mN")
    right.legend(fontsize=8, loc="lower right")
    left.axvline(scenarios.PLATE_GAP_MM + device.tip_radius_mm, color="0.3", linewidth=3)
    left.axvspan(-3, 0, color="0.9")
    left.text(-1.5, 4.2, "held", ha="center", fontsize=8)
    left.text(9.9, 4.2, "plate", ha="right", fontsize=8)
    left.set(aspect="equal", xlim=(-3, 11), ylim=(-5, 5), xlabel="x, mm", ylabel="y, mm", title="pushed by 1 mm")
    figure.savefig(FOLDER / "physics-buckling.png", dpi=90)


if __name__ == "__main__":
    draw_drag()
    draw_stick_slip()
    draw_whip()
    draw_buckling()
