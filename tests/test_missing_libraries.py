"""A library that is not installed is named; any other error is left as it is."""

from __future__ import annotations

from unittest.mock import patch

import missing_libraries
from missing_libraries import missing_library

MEND = "needs torch; install it with: pip install 'endopilot[learn]'"


def test_a_library_that_is_not_installed_is_named_also_behind_another_error() -> None:
    absent = ModuleNotFoundError("No module named 'no_such_library.part'", name="no_such_library.part")
    behind = RuntimeError("a fixture failed")
    behind.__cause__ = absent
    assert missing_library(absent) == missing_library(behind) == "no_such_library is not installed"


def test_what_a_command_asks_for_is_named_where_it_is_missing() -> None:
    with patch.object(missing_libraries, "extras_present", lambda: {"learn": False}):
        assert missing_library(AssertionError(f"endopilot train: {MEND}\n")) == MEND
    with patch.object(missing_libraries, "extras_present", lambda: {"learn": True}):
        assert missing_library(AssertionError(f"endopilot train: {MEND}\n")) is None


def test_other_errors_are_no_reason() -> None:
    assert missing_library(None) is None
    assert missing_library(ModuleNotFoundError("No module named 'numpy.gone'", name="numpy.gone")) is None
    assert missing_library(ModuleNotFoundError("No module named 'endopilot.gone'", name="endopilot.gone")) is None
