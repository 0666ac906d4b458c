"""
A wire of your own
==================

Write a device file, test its tip on the bench, and compare it with a shipped wire in a vessel.

**You need** the numbers of your wire: diameter, stiffness EI and GJ along its length, tip shape, friction. A device
is a YAML file. Every constant in it names its source, so that a reader can judge it.
"""

# %%
# Start from a shipped wire
# -------------------------
# ``endopilot devices`` lists the shipped wires; ``endopilot devices workhorse-014 --yaml > my-wire.yaml`` writes one
# down. We do the same in Python, make the tip softer, shape it to 75° over 5 mm, and coat it.

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import yaml

import endopilot

folder = Path(tempfile.mkdtemp())
my_file = folder / "my-wire.yaml"
endopilot.write_device(endopilot.read_wire("workhorse-014"), output=my_file)
content = yaml.safe_load(my_file.read_text(encoding="utf-8"))
content["name"] = "my-wire"
content["bend_stiffness_n_mm2"] = {"value": [0.2, 0.2, 1.2, 8, 30, 80], "source": "three-point bending, our bench"}
content["twist_stiffness_n_mm2"] = {"value": [0.154, 0.154, 0.92, 6.2, 23, 62], "source": "EI / 1.3, round section"}
content["tip_load_n"] = {"value": 0.0049, "source": "0.5 gf, our data sheet"}
content["tip_bend"] = {"angle_deg": 75, "length_mm": 5, "source": "shaped over a needle"}
content["friction"] = {"value": 0.06, "source": "hydrophilic coating, pulled over a wet plate"}
my_file.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")

mine, shipped = endopilot.read_wire(my_file), endopilot.read_wire("workhorse-014")
for device in (shipped, mine):
    print(f"{device.name}: EI at the tip {device.bend_stiffness_n_mm2[0]} N·mm², friction {device.friction}")

# %%
# A mistake is one line that names the file, the field, the value and the mend.

wrong = folder / "wrong.yaml"
wrong.write_text(my_file.read_text(encoding="utf-8").replace("0.06", "-0.06"), encoding="utf-8")
try:
    endopilot.read_wire(wrong)
except endopilot.InputError as error:
    print(str(error).replace(str(folder), "FOLDER"))

# %%
# Test the tip
# ------------
# Catalogues state a *tip load*: the force at which the straight distal 10 mm buckles against a plate. A uniform tip
# buckles at :math:`\pi^2 EI/4L^2`. The simulated test should agree with your data sheet; if it does not, one of the two
# numbers is wrong. On the command line: ``endopilot devices my-wire.yaml --tip-load``.

figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
for device, color in ((shipped, "C0"), (mine, "C1")):
    test = endopilot.simulate_tip_load(device)
    euler = np.pi**2 * device.bend_stiffness_n_mm2[0] / (4 * 10.0**2)
    axes.plot(1e3 * test.pushed_mm, 1e3 * test.force_n, ".-", color=color, label=f"{device.name}, simulated")
    axes.axhline(1e3 * euler, color=color, ls="--", lw=1, label=f"{device.name}, π²EI/4L²")
    print(f"{device.name}: {1e3 * test.load_n:.2f} mN, data sheet {1e3 * device.tip_load_n:.2f} mN")
axes.set(xlabel="holder lowered by, µm", ylabel="force on the plate, mN", title="Tip-load test", ylim=(0, None))
axes.legend(loc="lower right")
plt.show()

# %%
# Drive both wires
# ----------------
# :func:`endopilot.simulate` takes controls of shape (worlds, samples, 2): translation in mm/s and
# rotation in rad/s, one row every 0.5 s. Its results have an axis of devices, and the wire is the first. Twelve worlds
# start with the tip bend turned to a side each, then push on at 5 mm/s for 12 s. All worlds run side by side, and no
# result depends on another world.

anatomy = next(endopilot.make_atlas(config=endopilot.AtlasConfig(vessel="lca", seed=41, population="textbook")))
worlds, samples = 12, 24
control = np.tile([5.0, 0.0], (worlds, samples, 1))
start = np.column_stack([np.full(worlds, 2.0), np.linspace(0, 2 * np.pi, worlds, endpoint=False)])
rollouts = {
    device.name: endopilot.simulate(anatomy, device, control, initial=start, record_shape=True)
    for device in (shipped, mine)
}

# %%
# Each black line is one world after 12 s, its tip the dot. The longer bend enters the circumflex artery, which the
# shipped wire never does.

figure, panels = plt.subplots(1, 2, figsize=(11.5, 4.4), layout="constrained")
for axes, (name, rollout) in zip(panels, rollouts.items(), strict=True):
    anatomy.plot(axes=axes, view="front", color="0.85")
    for nodes in rollout.shape[:, -1]:
        axes.plot(nodes[:, 0], nodes[:, 2], color="black", lw=1)
        axes.plot(nodes[0, 0], nodes[0, 2], "o", color="black", ms=4)
    axes.set(title=f"{name}: tips in {len(set(rollout.tip.branch[:, -1, 0]))} branches")
plt.show()

# %%
# One world over time: how far the wire is in, where its tip lies, and how hard it presses on the wall.

rollouts["my-wire"].plot(world=5)
plt.show()

# %%
# The push at the ostium hardly changes: most of it bends the shaft, and both wires have the same.

push = {name: float(np.median(rollout.base_force[:, -1])) for name, rollout in rollouts.items()}
for name, force in push.items():
    print(f"{name}: pushed with {1e3 * force:.1f} mN after 12 s, the median")

# %%
# What to take home
# -----------------
# A device is data: no code changes. ``simulate``, ``dataset``, ``plan`` and ``run`` take the path of your file as
# ``--device``. The tasks of the ladder state their own wires.

branches = {name: set(rollout.tip.branch[:, -1, 0].tolist()) for name, rollout in rollouts.items()}
print(f"branches entered: {branches}")
assert all(rollout.valid.all() for rollout in rollouts.values())
assert abs(endopilot.simulate_tip_load(mine).load_n / mine.tip_load_n - 1) < 0.05
assert branches["my-wire"] - branches["workhorse-014"], "the shaped tip enters a branch of its own"
assert abs(push["my-wire"] / push["workhorse-014"] - 1) < 0.1
