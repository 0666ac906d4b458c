"""
A wire in a vessel
==================

Sixteen wires start with their tips, bent by 75° over 5 mm, turned to sixteen sides. Which branch a tip enters depends
on that angle.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import endopilot

anatomy = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="lca", seed=41, population="textbook")))
worlds, samples = 16, 24
start = np.column_stack([np.full(worlds, 2.0), np.linspace(0, 2 * np.pi, worlds, endpoint=False)])
push = np.tile([5.0, 0.0], (worlds, samples, 1))
device = replace(endopilot.read_wire("workhorse-014"), tip_bend_rad=np.deg2rad(75), tip_bend_length_mm=5.0)
rollout = endopilot.simulate(anatomy, device, push, initial=start, record_shape=True)

figure, panels = plt.subplots(1, 3, figsize=(11, 4.6), sharex=True, sharey=True, layout="constrained")
colors = plt.cm.hsv(np.linspace(0, 1, worlds, endpoint=False))
for axes, sample in zip(panels, (7, 15, 23), strict=True):
    anatomy.plot(axes=axes, view="front", color="0.88")
    for nodes, color in zip(rollout.shape[:, sample], colors, strict=True):
        axes.plot(nodes[:, 0], nodes[:, 2], color=color, lw=1)
    axes.set(title=f"after {(sample + 1) * 0.5:g} s", xlabel="x (to the patient's left), mm")
    axes.set_aspect("equal")
panels[0].set(ylabel="z (to the head), mm", xlim=(-10, 80), ylim=(-75, 20))
wheel = plt.cm.ScalarMappable(plt.Normalize(0, 360), "hsv")
figure.colorbar(wheel, ax=panels, label="rotation φ at the start, °", ticks=[0, 90, 180, 270, 360])
plt.show()

assert rollout.valid.all()
assert len(set(rollout.tip.branch[:, -1, 0])) > 1
