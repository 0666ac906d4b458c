"""Navigation as environments for learning.

`import endopilot` has Gymnasium know them, imported before or after: `gymnasium.make("endopilot/Crux-v2")`. A program
that does not import it writes `endopilot.env:` before the name. A task of the ladder's version 1 ends in `-v0`.
"""

from __future__ import annotations

import sys  # and nothing else: `import endopilot` imports this module, and is to be quick

TYPE_CHECKING = False
if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec
    from types import ModuleType

_PERIOD_S, _SECONDS = 2 / 15, 60
"""As `endopilot.env.observation.CONTROL_PERIOD_S`, which would bring numpy, and as the reference navigation has it."""


def register_envs() -> None:
    """Have Gymnasium know all environments; `import endopilot` does so by itself."""
    import re
    from math import ceil
    from pathlib import Path

    import gymnasium

    ids = [("Navigate-v0", {}, _SECONDS), ("NavigateXray-v0", {"observation": "xray"}, _SECONDS)]
    ids.append(("NavigateCoaxial-v0", {"catheter": "microcatheter-1.7f"}, _SECONDS))
    for version, ending in ((1, "v0"), (2, "v2"), ("coaxial", "v2")):
        for file in sorted((Path(__file__).parents[1] / "tasks" / f"ladder_{version}").glob("*.yaml")):
            seconds = re.search(r"^seconds: (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            given = {"task": file.stem} | ({} if version == 1 else {"version": version})
            ids.append((f"{file.stem.title()}-{ending}", given, float(seconds[1]) if seconds else _SECONDS))
    for name, given, seconds in ids:
        steps = ceil(seconds / _PERIOD_S - 1e-9)
        if f"endopilot/{name}" not in gymnasium.registry:
            gymnasium.register(
                id=f"endopilot/{name}",
                entry_point="endopilot.env.single:NavigateEnv",
                vector_entry_point="endopilot.env.vector:NavigateVectorEnv",
                max_episode_steps=steps,
                kwargs=given | {"max_episode_steps": steps},  # which `make` itself keeps from the environment
            )


class _WithGymnasium:
    """A finder of modules that registers the environments as soon as somebody imports Gymnasium, which takes 0.2 s."""

    def find_spec(self, fullname: str, path: object, target: ModuleType | None = None) -> ModuleSpec | None:
        """Let others find the module, and register the environments once it has run."""
        if fullname != "gymnasium":
            return None
        from importlib.util import find_spec

        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        sys.meta_path.insert(0, self)  # who only asks does not import
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def and_register(module: ModuleType) -> None:
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                run(module)
                register_envs()

            spec.loader.exec_module = and_register
        return spec


if "gymnasium" in sys.modules:
    register_envs()
else:
    sys.meta_path.insert(0, _WithGymnasium())
