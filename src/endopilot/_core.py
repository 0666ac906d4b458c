"""The C++ core, in the build that suits this processor: `baseline`, or on x86-64 `avx2` or `avx512` (F, BW, CD, DQ,
VL), all of the same bits. The highest level that is built and supported is taken, or that of the environment variable
`ENDOPILOT_CORE`; its `LEVEL` says which it is."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.util import find_spec

from endopilot.errors import InputError

_LEVELS = ("baseline", "avx2", "avx512")
_VARIABLE = "ENDOPILOT_CORE"


def _choose() -> str:
    supported: list[str] = import_module("endopilot._core_baseline").supported_levels()
    supported = [level for level in supported if find_spec(f"endopilot._core_{level}")]
    asked = os.environ.get(_VARIABLE)
    if not asked:
        return supported[-1]
    if asked not in _LEVELS:
        raise InputError(f"{_VARIABLE}: {asked!r} is no level of the core; give one of {', '.join(_LEVELS)}")
    if asked not in supported:
        raise InputError(f"{_VARIABLE}: this processor does not run {asked!r}; give one of {', '.join(supported)}")
    return asked


sys.modules[__name__] = import_module(f"endopilot._core_{_choose()}")
