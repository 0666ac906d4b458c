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
# ``examples/my_policy.py`` holds one. It pushes and looks once a second. After a wrong branch it pulls back to before
# the fork, turns the wire by 120°, and pushes again.

import inspect
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import endopilot

sys.path.insert(0, str(Path("../../examples").resolve()))  # `endopilot ladder` also looks where it is called
from my_policy import TurnBack

print(inspect.getsource(TurnBack))

# %%
# One navigation
# --------------
# Try a policy on one navigation first. The task ``diagonal`` asks for the second diagonal branch of a left coronary
# artery within 90 s and below 0.2 N. The shipped policy ``forward`` pushes and nothing else.

from endopilot.navigation.baseline_policies import Forward
from endopilot.tasks.task import find_task

navigation = find_task("diagonal", 1).ladder_navigation(0)
records = {
    policy.__class__.__name__: endopilot.navigate(navigation, policy, seed=1) for policy in (Forward(), TurnBack())
}
for name, record in records.items():
    print(f"{name}: {record.reason} after {record.seconds:g} s, {record.exposures} exposures")

figure, (map_axes, time_axes) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
for branch in navigation.anatomy.tree.branches:
    x, _, z = branch.centerline.points.T
    map_axes.plot(x, z, color="0.85", lw=5, solid_capstyle="round", zorder=0)
for (name, record), color in zip(records.items(), ("0.4", "C0"), strict=True):
    x, _, z = record.tip_position[:, 0].T  # of the wire
    map_axes.plot(x, z, ".-", color=color, lw=1, ms=3, label=name)
    time_axes.plot(record.time_s, record.tip.abscissa[:, 0], color=color, label=name)
    shown = record.exposed
    time_axes.plot(record.time_s[shown], record.tip.abscissa[shown, 0], "o", color=color, ms=3)
goal = navigation.target.position(navigation.anatomy)
map_axes.plot(goal[0], goal[2], "*", color="C3", ms=13, label="target")
map_axes.set(xlabel="x (to the patient's left), mm", ylabel="z (to the head), mm", title="Tip from the front")
map_axes.set_aspect("equal")
map_axes.legend()
time_axes.set(xlabel="time, s", ylabel="Δtip, mm", title="Tip along the vessel; dots: X-ray exposures")
time_axes.legend()
plt.show()

# %%
# The ladder
# ----------
# A ladder score counts *safe success*: the target in time, with the wall force below the limit, through a robot with
# latency, backlash and encoder noise. On the command line:
# ``endopilot ladder --policy my_policy:TurnBack --tasks diagonal --patients 4``. All twelve tasks in all twenty
# patients take some minutes. Several processes drive the navigations: in a script of your own, make the call under
# ``if __name__ == "__main__":``.

from endopilot.ladder.ladder import LadderConfig, climb

folder = Path(tempfile.mkdtemp())
safe_success = {}
for policy in ("forward", "my_policy:TurnBack"):
    config = LadderConfig(policy=policy, tasks=("diagonal",), patients=4, version=1)
    row = climb(folder / policy.replace(":", "-"), config)[0]
    safe_success[policy] = row["safe_success"]
    print(f"{policy}: safe success {100 * row['safe_success']:.0f} %, {row['exposures']:.1f} exposures on average")

# %%
# A result that others can check
# ------------------------------
# The folder holds ``submission.json``: scores, versions, seeds, and the recorded controls of every navigation. Anyone
# can drive these controls again, without the policy, and compare every figure to the bit. On the command line:
# ``endopilot ladder --check submission.json``.

from endopilot.ladder.submission import check_submission

checked = check_submission(folder / "my_policy-TurnBack" / "submission.json")
print(f"{checked.policy}: {checked.navigations} navigations, first difference: {checked.difference}")

# %%
# What to take home
# -----------------
# A policy is a class; ``MODULE:OBJECT`` names it, and an installed package can give it a short name by the entry point
# ``endopilot.policies``. The page on the ladder lists the twelve tasks and the scores of the shipped policies.

assert records["TurnBack"].success and records["TurnBack"].safe
assert not records["Forward"].success
assert safe_success["my_policy:TurnBack"] > safe_success["forward"]
assert checked.difference is None
