"""
A dataset and a model
=====================

Simulate random navigations, train a small model of the wire on them, and set it beside the packaged one.

**You need** anatomies. This tutorial draws ten from the atlas. The real recipe takes 126 patients and an hour
(``make recipe-laptop``); here everything is small, so that it runs in two minutes.
"""

# %%
# Ten patients
# ------------

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import endopilot

folder = Path(tempfile.mkdtemp())
patients = []
for anatomy in endopilot.make_atlas(
    config=endopilot.AtlasConfig(vessel="rca", count=10, seed=7, population="textbook")
):
    patients.append(folder / anatomy.name)
    endopilot.write_anatomy(anatomy, output=patients[-1])

# %%
# A dataset
# ---------
# A navigation is a minute of random pushing, pulling, turning and resting, recorded every 0.5 s: the proximal state
# (Δ, φ), the controls, the tip (Δtip, γtip) and the forces. The folder follows the LeRobot v3 layout. Whole patients
# train, calibrate or test. On the command line: ``endopilot dataset patients/* -o dataset --sequences 12``. Several
# processes simulate: in a script of your own, make the call under ``if __name__ == "__main__":``.

endopilot.generate_dataset(
    patients,
    output=folder / "dataset",
    device=endopilot.read_wire("workhorse-014"),
    config=endopilot.DatasetConfig(sequences=12, seed=7),
)
dataset = endopilot.read_dataset(folder / "dataset")
for split in ("train", "seen_test", "calibrate", "test"):
    part = dataset.of_split(split)
    print(f"{split}: {len(part)} navigations of {len(set(part.anatomy))} patients")

# %%
# One navigation of a test patient. The tip does not follow the inserted length exactly: the wire cuts corners, which
# puts its tip ahead, and stores length in bends, which holds it back. The difference Δ − Δtip is the *slack*. It
# depends on the history, which is what a model has to learn.

test = dataset.of_split("test")
length, tip = test.inserted_length[:, :, 0], test.tip_abscissa[:, :, 0]  # device 0 is the wire, and here the only one
time_s = test.sample_period_s * np.arange(1, test.valid.shape[1] + 1)
one = int(np.argmax(np.ptp(length, axis=1)))
figure, (length_axes, slack_axes) = plt.subplots(2, 1, figsize=(8, 4.6), sharex=True, layout="constrained")
length_axes.plot(time_s, length[one], color="0.5", label="Δ, inserted length")
length_axes.plot(time_s, tip[one], color="C0", label="Δtip, tip along the vessel")
length_axes.set(ylabel="mm")
length_axes.legend()
slack_axes.plot(time_s, length[one] - tip[one], color="C1")
slack_axes.set(xlabel="time, s", ylabel="slack Δ − Δtip, mm")
plt.show()

# %%
# A model
# -------
# The paper's forward network is a Transformer that predicts the tip from the last 30 states. On the command line:
# ``endopilot train dataset -o run --network ff --max-seconds 30``.

endopilot.train(
    folder / "dataset",
    output=folder / "run",
    config=endopilot.TrainConfig(network="ff", max_seconds=30),
)

# %%
# Predict
# -------
# The first 30 states (15 s) are given. A model predicts the tip for the other 45 s from the controls alone. Three
# predictions of the test patients: the network; simulated wires (``"wires"``), which find friction and tip stiffness
# from the given states; and a baseline that holds slack and offset as they were last given.

given = 30
models = {"network": folder / "run", "wires": Path("wires")}
episodes = endopilot.Episodes.of_dataset(test)
predicted = {name: endopilot.load_model(run).rollout_forward(episodes).tip for name, run in models.items()}
offset, slack = test.tip_offset[:, :, 0], length - tip
held = np.broadcast_to(offset[:, [given - 1]], offset.shape)
predicted["hold slack"] = np.stack([length - slack[:, [given - 1]], held], axis=-1)[:, given:]
truth = np.stack([tip, offset], axis=-1)[:, given:]
error_mm = {name: np.abs(guess - truth).mean(axis=0) for name, guess in predicted.items()}
for name, error in error_mm.items():
    print(f"{name}: mean error {error[:, 0].mean():.2f} mm along the vessel, {error[:, 1].mean():.3f} mm across")

# %%
# Left: the errors in the navigation from above. Right: the mean error of all test navigations.

colors = {"network": "C0", "wires": "C2", "hold slack": "0.6"}
figure, (tip_axes, error_axes) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
since_s = time_s[given:] - time_s[given - 1]
for name, guess in predicted.items():
    tip_axes.plot(since_s, guess[one, :, 0] - truth[one, :, 0], color=colors[name], label=name)
    error_axes.plot(since_s, error_mm[name][:, 0], color=colors[name], label=name)
tip_axes.axhline(0, color="black", lw=0.8)
tip_axes.set(xlabel="time since the last given state, s", ylabel="error of Δtip, mm", title="One navigation")
tip_axes.legend()
error_axes.set(xlabel="time since the last given state, s", ylabel="mean |error of Δtip|, mm", ylim=(0, None))
error_axes.set(title=f"{len(test)} navigations of {len(set(test.anatomy))} test patients")
error_axes.legend()
plt.show()

# %%
# What to take home
# -----------------
# More patients help more than more navigations. ``endopilot evaluate run -o evaluation`` measures a run by four
# protocols, with baselines and intervals over patients, and writes ``report.html``.

assert (dataset.valid.all(axis=1)).mean() > 0.99
assert error_mm["wires"][:, 0].mean() < 0.1 * error_mm["hold slack"][:, 0].mean()
