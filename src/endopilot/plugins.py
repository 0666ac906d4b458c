"""What a user may add without touching the package: `Registry` finds an implementation by its name, the package's own,
or by MODULE:OBJECT, in the current directory or on Python's path."""

from __future__ import annotations

import contextlib
import importlib
import sys
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from endopilot import __version__
from endopilot.errors import InputError, Stopped
from endopilot.files import sha256

_LONGEST_MESSAGE = 200  # more of an exception's message is left out, characters


@dataclass(frozen=True)
class Registry:
    """Implementations of one thing by name. Messages begin with `setting`; `shipped` has MODULE:OBJECT of each of the
    package's, imported if asked for."""

    setting: str
    shipped: Mapping[str, str]

    def names(self) -> tuple[str, ...]:
        """Return the names of the package's own implementations."""
        return tuple(self.shipped)

    def load(self, name: str) -> Any:
        """Return the object behind a name; InputError for no such name, or a module that cannot be imported or lacks
        it."""
        module_name, _, attribute = self.shipped.get(name, name).partition(":")
        if name in self.shipped:
            return getattr(importlib.import_module(module_name), attribute)
        if not attribute or not all(part.isidentifier() for part in (*module_name.split("."), attribute)):
            raise InputError(
                f"{self.setting}: {name!r}; choose from {', '.join(self.shipped)}, "
                "or give MODULE:OBJECT, such as my_module:MyClass, of a module of your own"
            )
        module = self._module(name, module_name)
        if not hasattr(module, attribute):
            raise InputError(
                f"{self.setting}: {name!r}: {module.__file__ or module_name} holds no {attribute}; correct the name"
            )
        return getattr(module, attribute)

    def check(self, name: str) -> None:
        """Refuse a name that `load` would refuse, without importing what the package ships."""
        if name not in self.shipped:
            self.load(name)

    def origin(self, name: str) -> str:
        """Return where an implementation comes from: the package's version, or a module's file and its SHA-256."""
        if name in self.shipped:
            return f"endopilot {__version__}"
        self.load(name)
        file = Path(sys.modules[name.partition(":")[0]].__file__ or "")
        return f"{file.name} sha256:{sha256(file)}" if file.is_file() else name

    def _module(self, name: str, module_name: str) -> ModuleType:
        here = str(Path.cwd())
        if here not in sys.path:  # the `endopilot` command does not look there by itself
            sys.path.append(here)
        importlib.invalidate_caches()
        with self.running(name, f"{module_name} cannot be imported"):
            try:
                return importlib.import_module(module_name)
            except ModuleNotFoundError as error:
                if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
                    raise
                mend = "go to its folder, or add that to PYTHONPATH"
                if module_name.endswith(".py"):
                    mend = f"a module is named without .py: {name.replace('.py:', ':')}"
                raise InputError(
                    f"{self.setting}: {name!r}: there is no module {error.name} in the current directory or on "
                    f"Python's path; {mend}"
                ) from error

    @contextlib.contextmanager
    def running(self, name: str, failure: str) -> Iterator[None]:
        """Run what is behind a name, as the block does: an exception out of a user's code, if only `SystemExit`,
        becomes an InputError that names it and begins with `failure`; what it prints goes to standard error."""
        if name in self.shipped:
            yield
            return
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield
        except (InputError, Stopped, MemoryError):
            raise
        except BaseException as error:
            raise InputError(f"{self.setting}: {name!r}: {failure} ({described(error)}); mend it") from error


def described(error: BaseException) -> str:
    """Return an error of a user's own code in one line: kind, message, and the place where it was raised."""
    if isinstance(error, SyntaxError):
        place = f"{Path(error.filename or '').name} line {error.lineno}"
        return f"{type(error).__name__}: {error.msg}, {place}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())[:_LONGEST_MESSAGE]
    said = f"{type(error).__name__}: {message}" if message else type(error).__name__
    return f"{said}, {Path(last.filename).name} line {last.lineno}"
