"""
A policy of your own on the ladder
==================================

Write a policy, score it on a task of the ladder in patients that it has never met, and keep a result that others can
check.

**You need** a class with two methods, ``start`` and ``decide``. The package is not touched.
"""

# %%
# The policy
# ----------
# Every 0.5 s a policy gets an :class:`endopilot.Observation`: time, the encoders' readings and, where it
# asked for X-ray, the measured tip. It answers with a :class:`endopilot.Decision`: of each device a
# translation in mm/s and a rotation in rad/s, and whether X-ray is to be on at the next decision.
#
# This one pushes and looks once a second. After a wrong branch it pulls back to before the fork, turns the wire by
# 120°, and pushes again. It lies in a file of its own, so that the ladder's processes find it too.

import os
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import endopilot

CODE = """
import math
import endopilot

class TurnBack:
    def start(self, navigation, seed):
        # where each branch leaves the route to the target, mm from the ostium; infinite on the route itself
        self.fork_mm = navigation.anatomy.tree.departures(navigation.target.branch)
        self.pull_to_mm = self.turn_to_rad = None

    def decide(self, observation):
        tip, (inserted_mm, rotation_rad) = observation.tip, observation.devices[0]  # of the wire
        if tip is not None and math.isfinite(self.fork_mm[tip.branch]):  # in a wrong branch: so much has to come out
            self.pull_to_mm = max(inserted_mm - (tip.abscissa - self.fork_mm[tip.branch]) - 4.0, 0.0)
            self.turn_to_rad = rotation_rad + 2 * math.pi / 3
        if self.pull_to_mm is not None and inserted_mm > self.pull_to_mm:
            return endopilot.Decision(((-5.0, 0.0),))
        self.pull_to_mm = None
        if self.turn_to_rad is not None and rotation_rad < self.turn_to_rad - 0.1:
            return endopilot.Decision(((0.0, min(3.0, 2 * (self.turn_to_rad - rotation_rad))),))
        self.turn_to_rad = None
        return endopilot.Decision(((5.0, 0.0),), expose=observation.time_s % 1.0 == 0.5)
"""
folder = Path(tempfile.mkdtemp())
(folder / "my_policy.py").write_text(CODE, encoding="utf-8")
sys.path.insert(0, str(folder))
from my_policy import TurnBack

# %%
# One navigation
# --------------
# Try a policy on one navigation first. The task ``diagonal`` asks for the second diagonal branch of a left coronary
# artery within 90 s and below 0.2 N. The shipped policy ``forward`` pushes and nothing else.

navigation = endopilot.find_task("diagonal", version=1).ladder_navigation(0)
records = {
    name: endopilot.NavigationLoop(navigation, policy, seed=1).run()
    for name, policy in (("forward", endopilot.make_policy("forward")), ("TurnBack", TurnBack()))
}
for name, record in records.items():
    print(f"{name}: {record.reason} after {record.seconds:g} s, {record.exposures} exposures")

axes = navigation.anatomy.plot(view="front").axes[0]
for (name, record), color in zip(records.items(), ("0.4", "black"), strict=True):
    x, _, z = record.tip_position[:, 0].T  # of the wire
    axes.plot(x, z, ".-", color=color, lw=1, ms=3, label=f"{name}'s tip")
goal = navigation.target.position(navigation.anatomy)
axes.plot(goal[0], goal[2], "*", color="C3", ms=13, label="target")
axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
plt.show()

# %%
# What ``TurnBack`` did over time: it draws the wire back once and tries again.

records["TurnBack"].trajectory.plot()
plt.show()

# %%
# The ladder
# ----------
# A ladder score counts *safe success*: the target in time, with the wall force below the limit, through a robot with
# latency, play and encoder noise. On the command line:
# ``endopilot ladder --policy my_policy:TurnBack --tasks diagonal --patients 4``. All twelve tasks in all twenty
# patients take some minutes. Several processes drive the navigations: in a script of your own, make the call under
# ``if __name__ == "__main__":``.

os.chdir(folder)  # the ladder's processes look for a policy where they are called
safe_success = {}
for policy in ("forward", "my_policy:TurnBack"):
    config = endopilot.LadderConfig(policy=policy, tasks=("diagonal",), patients=4, version=1)
    row = endopilot.climb(output=folder / policy.replace(":", "-"), config=config)[0]
    safe_success[policy] = row["safe_success"]
    print(f"{policy}: safe success {100 * row['safe_success']:.0f} %, {row['exposures']:.1f} exposures on average")

# %%
# A result that others can check
# ------------------------------
# The folder holds ``submission.json``: scores, versions, seeds, and the recorded controls of every navigation. Anyone
# can drive these controls again, without the policy, and compare every figure to the bit. On the command line:
# ``endopilot ladder --check submission.json``.

os.chdir(folder)
checked = endopilot.check_submission(folder / "my_policy-TurnBack" / "submission.json")
print(f"{checked.policy}: {checked.navigations} navigations, first difference: {checked.difference}")

# %%
# What to take home
# -----------------
# A policy is a class; ``MODULE:OBJECT`` names it, and an installed package can give it a short name by the entry point
# ``endopilot.policies``. The page on the ladder lists the twelve tasks and the scores of the shipped policies.

assert records["TurnBack"].success and records["TurnBack"].safe
assert not records["forward"].success
assert safe_success["my_policy:TurnBack"] > safe_success["forward"]
assert checked.difference is None
