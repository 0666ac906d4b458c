"""
What the C-arm measures
=======================

Expose the same tip 400 times and look at the errors: with two views the tip is located to fractions of a millimetre;
with one view depth is known only through the vessel.
"""

import matplotlib.pyplot as plt
import numpy as np

import endopilot

anatomy = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="rca", seed=0, population="textbook")))
device = endopilot.read_wire("workhorse-014")
push = np.tile([5.0, 0.0], (1, 16, 1))
rollout = endopilot.simulate(anatomy, device, push)
tip, direction = rollout.tip_position[0, -1, 0], rollout.tip_direction[0, -1, 0]
length = float(rollout.inserted_length[0, -1, 0])

figure, axes = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
medians = {}
for name, biplane, color in (("two views", True, "C0"), ("one view", False, "C1")):
    config = endopilot.FluoroscopeConfig(biplane=biplane)
    c_arm = endopilot.Fluoroscope(anatomy, device.tip_radius_mm, config=config)
    random = np.random.default_rng(0)
    shown = np.array([c_arm.measure(tip, direction, length, random).position for _ in range(400)])
    error_mm = np.linalg.norm(shown - tip, axis=1)
    medians[name] = float(np.median(error_mm))
    axes.hist(
        error_mm, bins=np.linspace(0, 4, 41), color=color, alpha=0.6, label=f"{name}: median {medians[name]:.2f} mm"
    )
axes.set(xlabel="distance from the true tip, mm", ylabel="exposures of 400")
axes.legend()
plt.show()

assert medians["two views"] < medians["one view"]
