"""What tests with anything in a file have in common: so many examples, always the same, and one line at most."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from endopilot.errors import InputError


def bounded(examples: int) -> settings:
    """Return settings of so many examples, the same in every run."""
    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


def outcome(read: Callable[[], Any], capfd: pytest.CaptureFixture[str]) -> Any:
    """Return what a reader returns, None where it refuses in one line; it says nothing on the screen."""
    found = None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            found = read()
        except InputError as error:
            assert len(str(error)) < 1000
    captured = capfd.readouterr()
    assert captured.err == captured.out == ""
    return found


def refusal(path: Path, content: str | bytes, read: Callable[[Path], Any]) -> str:
    """Return what a reader says of a file with this content, which it refuses by name."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        read(path)
    assert str(error.value).startswith(f"{path}: ")
    return str(error.value).removeprefix(f"{path}: ")


def read_or_refused(path: Path, content: str | bytes, read: Callable[[Path], Any]) -> Any:
    """Return what a file with this content is read as; None where one line refuses it by name."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    try:
        return read(path)
    except InputError as error:
        assert str(error).startswith(str(path)) and len(str(error)) < 1500, error
        return None


def damaged(content: bytes, flips: list[tuple[int, int]], cut: int | None = None) -> bytes:
    """Return bytes of which some have other values, and of which the first `cut` are left."""
    result = bytearray(content)
    for place, value in flips:
        result[place % len(result)] = value
    return bytes(result[:cut])
