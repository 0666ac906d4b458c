"""Checks arguments and results against annotations, array shapes among them, while tests run.

The option `--jaxtyping-packages` makes every function and class of the package begin with `@jaxtyping.jaxtyped`. That
one binds the arguments of each call and checks them twice, which took more than half of the time of many tests.
`checked` finds the same faults and checks once: it takes `jaxtyped`'s place before the package is imported. What one
test calls again and again is checked in the first calls of that test, and after them in every sixteenth.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping

FIRST, EVERY = 32, 16
"""Calls of a function that are checked in a test: the first ones, and one of so many later."""

_jaxtyped = jaxtyping.jaxtyped
_test = 0


def check_quickly() -> None:
    """Let what is imported from now on be checked by `checked`."""
    jaxtyping.jaxtyped = checked


def begin_test() -> None:
    """Let every function be checked in its next calls."""
    global _test
    _test += 1


def checked(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a decorator of functions and dataclasses that lets them check what they are called with.

    A name of a size means one number within one call, its result included.
    """
    return functools.partial(_decorated, typechecker=typechecker)


def _decorated(subject: Any, *, typechecker: Callable[[Any], Any]) -> Any:
    if isinstance(subject, (classmethod, staticmethod)):
        return type(subject)(_decorated(subject.__func__, typechecker=typechecker))
    if isinstance(subject, property):
        parts = (subject.fget, subject.fset, subject.fdel)
        return property(*(part and _decorated(part, typechecker=typechecker) for part in parts))
    if inspect.isclass(subject):
        if dataclasses.is_dataclass(subject) and isinstance(subject.__init__, types.FunctionType):
            subject.__init__ = _decorated(subject.__init__, typechecker=typechecker)
        return subject
    if not getattr(subject, "__annotations__", None) or hasattr(subject, "_is_checked"):
        return subject
    if inspect.isgeneratorfunction(subject):  # a check of the whole would wait until it begins
        return _jaxtyped(subject, typechecker=typechecker)

    def begin(*args: Any, **kwargs: Any) -> Any:
        nonlocal body
        body = _checking(subject, typechecker)  # at the first call: every process imports far more than it calls
        return body(*args, **kwargs)

    body: Callable[..., Any] = begin
    test = calls = 0

    @functools.wraps(subject)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal test, calls
        if test != _test:
            test, calls = _test, 0
        calls += 1
        return (subject if calls > FIRST and calls % EVERY else body)(*args, **kwargs)

    call._is_checked = True
    return call


def _checking(function: types.FunctionType, typechecker: Callable[[Any], Any]) -> Callable[..., Any]:
    """Return the function with checks of its arguments and its result."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__module__ = function.__kwdefaults__, function.__module__
    copy.__qualname__ = function.__qualname__
    hints = {name: _resolved(hint, function.__globals__) for name, hint in function.__annotations__.items()}
    copy.__annotations__ = hints
    inner = typechecker(copy)
    if not any(map(_has_shape, hints.values())):
        return inner

    def scoped(*args: Any, **kwargs: Any) -> Any:
        with _jaxtyped("context"):  # the sizes of this call
            return inner(*args, **kwargs)

    return scoped


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """Return what an annotation means; what only type checkers import is anything, as it is to `jaxtyped`."""

    def stub(value: Any) -> None: ...

    stub.__annotations__ = {"value": hint}
    try:
        return typing.get_type_hints(stub, names, include_extras=True)["value"]
    except Exception:
        return Any


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, list):  # the arguments of a callable
        return any(map(_has_shape, hint))
    return (isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)) or any(
        map(_has_shape, typing.get_args(hint))
    )
