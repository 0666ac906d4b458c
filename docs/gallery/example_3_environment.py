"""
A Gymnasium environment, 64 worlds at once
==========================================

Push and turn with random actions in 64 worlds of the task ``crux``. A vector environment is one simulator; each world's
course is the same as in a single environment with the same seed.
"""

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

worlds = gymnasium.make_vec("endopilot.env:endopilot/Crux-v2", num_envs=64, patients=4)
worlds.action_space.seed(0)
observation, info = worlds.reset(seed=0)
lengths, tips = [info["inserted_length"]], [info["tip_abscissa"]]
action = np.zeros((64, 2), dtype=np.float32)
random = np.random.default_rng(0)
for step in range(150):  # 20 s at 7.5 Hz; every second a new action, most of them pushes
    if step % 8 == 0:
        action[:, 0] = random.uniform(-0.4, 1.0, 64)
        action[:, 1] = random.uniform(-1.0, 1.0, 64)
    observation, reward, terminated, truncated, info = worlds.step(action)
    lengths.append(info["inserted_length"])
    tips.append(info["tip_abscissa"])

time_s = np.arange(len(tips)) / 7.5
figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
axes.plot(time_s, np.array(tips), color="C0", lw=0.7, alpha=0.5)
axes.plot([], [], color="C0", lw=1, label="Δtip of one world")
axes.plot(time_s, np.array(tips).mean(axis=1), color="black", lw=2, label="mean")
axes.set(xlabel="time, s", ylabel="tip along the vessel, mm", title="64 worlds, random actions")
axes.legend()
plt.show()

assert observation.shape == (64, 31)
assert info["valid"].all()
