"""
From a mask to a plan
=====================

Segment a coronary artery, extract its anatomy, and plan how to drive a guidewire into a side branch.

**You need** a CT angiogram or the mask of a vessel. This tutorial makes both from a synthetic patient, so that we know
the truth.
"""

# %%
# A patient
# ---------
# The *atlas* draws vessel trees from published statistics. The *phantom* turns a tree into the CT angiogram that a
# scanner would have made of it, in HU.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import endopilot

folder = Path(tempfile.mkdtemp())
patient = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="rca", seed=0, population="textbook")))
ct = endopilot.make_phantom(patient, config=endopilot.PhantomConfig(), seed=0)
print(f"{patient.name}: {ct.voxels.shape[::-1]} voxels of {ct.spacing_mm} mm")

# %%
# From CT to mask
# ---------------
# :func:`endopilot.segment` finds one coronary tree and its ostium without any seed. On the command
# line this is ``endopilot segment CT -o mask.nii.gz``. If you have a mask already, start at the next step.

mask = endopilot.segment(ct, config=endopilot.SegmentConfig(method="coronary", vessel="rca"))
error_mm = np.linalg.norm(mask.ostium.position - patient.insertion.position)
print(f"{mask.volume.voxels.sum()} lumen voxels; the ostium errs by {error_mm:.2f} mm")

# %%
# From mask to anatomy
# --------------------
# An *anatomy* is what a wire needs: the centerline tree with section names, the signed distance to the wall, and the
# ostium. :func:`endopilot.write_anatomy` stores it as a folder that 3D Slicer and ParaView open. On the
# command line: ``endopilot anatomy mask.nii.gz --vessel rca -o patient``.

anatomy = endopilot.extract_anatomy(mask, name="patient", config=endopilot.AnatomyConfig(vessel="rca"))
endopilot.write_anatomy(anatomy, output=folder / "patient")
print(f"{len(anatomy.tree.branches)} branches, sections {', '.join(anatomy.tree.section_names)}")

# %%
# Two views of the same vessel: a slice of the CT with the mask, and the extracted tree. An anatomy plots itself.

k = int(mask.volume.voxels.sum(axis=(1, 2)).argmax())
left, top = ct.index_to_world(np.array([0, 0, k]))[:2]
right, bottom = ct.index_to_world(np.array([ct.voxels.shape[2] - 1, ct.voxels.shape[1] - 1, k]))[:2]
extent = (left, right, bottom, top)

figure, (slice_axes, tree_axes) = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
slice_axes.imshow(ct.voxels[k], cmap="gray", vmin=-150, vmax=650, extent=extent)
slice_axes.contour(mask.volume.voxels[k], levels=[0.5], colors="lime", linewidths=1.2, extent=extent, origin="upper")
slice_axes.set(xlabel="x (to the patient's left), mm", ylabel="y (to the back), mm", title="Axial slice and mask")
anatomy.plot(axes=tree_axes, view="front")
plt.show()

# %%
# From anatomy to plan
# --------------------
# :func:`endopilot.plan` searches the rod core for controls that bring the tip to a target: a section such
# as ``"4"`` or ``"PDA"``, or a point in LPS mm. It then replays them at the finest settings and checks that the target
# is reached and the wall force stays below the limit. On the command line:
# ``endopilot plan patient --target 4 -o plan``.

route = endopilot.plan(anatomy, "4", config=endopilot.PlanConfig(force_limit_n=0.3))
print(f"reached: {route.reached}, peak wall force {route.force.max():.3f} N, planned in {route.seconds_to_plan:.1f} s")

# %%
# A plan keeps what the rod core makes of its controls: Δtip reaches the target, the dotted line. A trajectory plots
# itself too.

route.trajectory.plot().axes[0].axhline(route.navigation.target.abscissa, color="C3", ls=":", lw=1)
plt.show()

# %%
# What to take home
# -----------------
# Four calls lead from a CT to controls: ``segment``, ``extract_anatomy``, ``write_anatomy``, ``plan``. The plan is
# safe in the simulator, with the friction and the stiffness that the device file states. The tutorial on X-ray advice
# shows what happens when they are wrong.

assert error_mm < 1.5
assert route.reached
assert route.within_force_limit
