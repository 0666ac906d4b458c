"""Runs `endopilot` commands in this process and checks how they end."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from endopilot.cli import main


def output_of(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> str:
    """Run a command that ends with this code, and return what it prints."""
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert leaving.value.code == code, captured.err
    return captured.out


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> Any:
    """Run a command with --json and return its figures."""
    return json.loads(output_of(capsys, *arguments, "--json"))


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a command with bad input: exit code 2, one line on standard error, which is returned, nothing printed.

    What a slow machine adds, a line for every piece of work of more than two seconds, does not count.
    """
    capsys.readouterr()
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert leaving.value.code == 2, captured.err
    assert captured.out == ""
    lines = [line for line in captured.err.strip().splitlines() if not re.search(r": done in [\d.]+ s$", line)]
    assert len(lines) == 1, captured.err
    return lines[0]
