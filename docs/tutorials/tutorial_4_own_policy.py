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

folder = Path(tempfile.mkdtemp())
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
