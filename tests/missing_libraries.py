"""Which library a test failed for want of: `conftest.py` skips such a test, and names the library.

Where all libraries are installed, nothing is skipped.
"""

from __future__ import annotations

import re
from importlib.util import find_spec

from endopilot.extras import extras_present

_MEND = re.compile(r"needs (?:\S+|more libraries); install (?:it|them) with: pip install 'endopilot\[([a-z,-]+)\]'")
"""How a command says that extras are missing (`endopilot.extras`)."""


def missing_library(error: BaseException | None) -> str | None:
    """Return what to install, in words; None if the error, and those that led to it, have another cause."""
    seen: list[BaseException] = []
    while error is not None and error not in seen:
        seen.append(error)
        library = error.name.partition(".")[0] if isinstance(error, ModuleNotFoundError) and error.name else ""
        if library not in ("", "endopilot", "benchmarks") and find_spec(library) is None:
            return f"{library} is not installed"
        mend = _MEND.search(str(error))
        if mend and not all(extras_present()[extra] for extra in mend[1].split(",")):
            return mend[0]
        error = error.__cause__ or error.__context__
    return None
