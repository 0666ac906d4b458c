"""
Friction in bends
=================

Push the same wire through the same bends with four coefficients of friction. The wire leans on the outer walls, where
friction adds to the push. Each bend multiplies what the bends ahead of it ask for, as a capstan does.
"""

import matplotlib.pyplot as plt
import numpy as np

import endopilot

anatomy = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="rca", seed=0, population="textbook")))
friction = np.array([0.0, 0.05, 0.1, 0.2])  # of each world; 0.05 is a hydrophilic coating, 0.2 bare steel
push = np.tile([5.0, 0.0], (len(friction), 44, 1))
rollout = endopilot.simulate(anatomy, "workhorse-014", push, friction=friction)
inserted_mm, force_n = rollout.inserted_length[:, :, 0], rollout.base_force[:, :, 0]  # device 0 is the wire

figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
for world, coefficient in enumerate(friction):
    axes.plot(inserted_mm[world], 1e3 * force_n[world], color=f"C{world}", label=f"µ = {coefficient:g}")
axes.set(xlabel="inserted length Δ, mm", ylabel="push of the drive, mN")
axes.legend()
plt.show()

assert rollout.valid.all()
assert np.all(np.diff(force_n[:, -1]) > 0), "the push grows with friction"
assert force_n[-1, -1] > 1.5 * force_n[0, -1]
