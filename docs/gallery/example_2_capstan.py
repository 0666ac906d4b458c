r"""
Friction in bends: the capstan equation
=======================================

A string pulled through a bend needs :math:`T_2 = T_1 e^{\mu\theta}`, where θ is the angle by which the string turns.
A wire with bending stiffness needs more.
"""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.verification.scenes import drag_through_bends

friction, bends = 0.2, range(0, 7, 2)
figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
for stiffness, color, name in ((0.1, "C0", "string"), (1.0, "C1", "wire"), (3.0, "C3", "stiffer wire")):
    runs = [drag_through_bends(count, friction=friction, bend_n_mm2=stiffness) for count in bends]
    turning = np.array([run.wire_turning_rad for run in runs])
    ratio = np.array([run.ratio for run in runs])
    axes.semilogy(np.rad2deg(turning), ratio, "o", color=color, label=f"{name}, EI = {stiffness:g} N·mm²")
    if stiffness == 0.1:
        string = ratio / np.exp(friction * turning)
theta = np.linspace(0, 260, 50)
axes.semilogy(theta, np.exp(friction * np.deg2rad(theta)), "k-", lw=1, label="exp(µθ), µ = 0.2")
axes.set(xlabel="angle θ by which the wire turns in all, °", ylabel="pull / load on the tip", ylim=(0.95, None))
axes.set_yticks([1, 1.5, 2, 3, 4], labels=["1", "1.5", "2", "3", "4"])
axes.set_yticks([], minor=True)
axes.legend()
plt.show()

assert np.all(np.abs(string - 1) < 0.01)
