"""endopilot: from a CT angiogram to an agent that drives an endovascular guidewire.

The names of this module are what the package offers; `docs/reference.md` describes each. A name is imported when it is
first used, so that `import endopilot` is quick and brings no large library. All other modules are internal: they may
change with any version.

One stage is one package with one entry function, and data flows one way:

    imaging -> anatomy -> simulation -> dataset -> models -> control -> evaluation

Units are mm, N, s, rad and HU; world coordinates are LPS mm throughout.
"""

from functools import cache
from importlib import import_module

__version__ = "0.2.0"
register_envs = import_module("endopilot.env").register_envs  # by name: rooms import from the left, and all import this


def __getattr__(name: str) -> object:
    """Import a name of `__init__.pyi` from its module."""
    from endopilot.extras import extra_named

    import_name, _, names = _stub()
    if name == "__all__":
        return names
    with extra_named(f"endopilot.{name}"):
        return import_name(name)


def __dir__() -> list[str]:
    return _stub()[1]()


@cache
def _stub():
    """Return how the names of `__init__.pyi` are imported, `dir` of this module, and the names."""
    import lazy_loader  # reads the stub, which takes as long as all else of `endopilot --help`

    return lazy_loader.attach_stub(__name__, __file__)
