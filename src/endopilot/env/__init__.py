"""Navigation as environments for learning.

Importing this package registers `endopilot/Navigate-v0`, `endopilot/NavigateCoaxial-v0` and one environment for each
task of the ladder with Gymnasium, which does so itself where the package stands before the name:
`gymnasium.make("endopilot.env:endopilot/Navigate-v0")`.
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

for _name, _given in (
    ("Navigate", {}),
    ("NavigateCoaxial", {"catheter": "microcatheter-1.7f"}),
    *((name, {"task": name.lower()}) for name in TASKS),
):
    gymnasium.register(
        id=f"endopilot/{_name}-v0",
        entry_point="endopilot.env.single:NavigateEnv",
        vector_entry_point="endopilot.env.vector:NavigateVectorEnv",
        kwargs=_given,
    )
