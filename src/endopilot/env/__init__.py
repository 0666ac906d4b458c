"""Navigation as environments for learning.

Importing this package registers `endopilot/Navigate-v0`, `endopilot/NavigateXray-v0`, `endopilot/NavigateCoaxial-v0`
and one environment for each task of the ladder with Gymnasium, which does so itself where the package stands before the
name: `gymnasium.make("endopilot.env:endopilot/Navigate-v0")`. A task of the ladder's version 1 ends in `-v0`, one of
its version 2 or of wire and catheter in `-v2`.
"""

import gymnasium

TASKS = (
    "Straight",
    "Descending",
    "Stenosis",
    "Tortuous",
    "Crux",
    "Circumflex",
    "Diagonal",
    "Marginal",
    "Portal",
    "Middle-Cerebral",
    "Anterior-Cerebral",
    "Carotid",
)
"""Names of the ladder's tasks as the environments have them; those of the files are in lower case."""
COAXIAL_TASKS = ("Follow", "Steep-Carotid", "Side-Branch", "Distal-Cerebral")
"""The same of those of wire and catheter."""

for _id, _given in (
    ("Navigate-v0", {}),
    ("NavigateXray-v0", {"observation": "xray"}),
    ("NavigateCoaxial-v0", {"catheter": "microcatheter-1.7f"}),
    *((f"{name}-v0", {"task": name.lower()}) for name in TASKS),
    *((f"{name}-v2", {"task": name.lower(), "version": 2}) for name in TASKS),
    *((f"{name}-v2", {"task": name.lower(), "version": "coaxial"}) for name in COAXIAL_TASKS),
):
    gymnasium.register(
        id=f"endopilot/{_id}",
        entry_point="endopilot.env.single:NavigateEnv",
        vector_entry_point="endopilot.env.vector:NavigateVectorEnv",
        kwargs=_given,
    )
