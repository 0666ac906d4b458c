"""endopilot: from a CT angiogram to an agent that drives an endovascular guidewire.

The names of this module are what the package offers; `docs/reference.md` describes each. A name is imported when it is
first used, so that `import endopilot` is quick and brings no large library. All other modules are internal: they may
change with any version.

One stage is one package with one entry function, and data flows one way:

    imaging -> anatomy -> simulation -> dataset -> models -> control -> evaluation

Units are mm, N, s, rad and HU; world coordinates are LPS mm throughout.
"""

from typing import Any

import lazy_loader

from endopilot.extras import extra_named

__version__ = "0.2.0"

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # the names stand in __init__.pyi


def __getattr__(name: str) -> Any:
    """Import a name of `__init__.pyi` from its module."""
    with extra_named(f"endopilot.{name}"):
        return _import_name(name)
