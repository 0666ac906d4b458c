"""The table of signals: it follows the core's, and files, tables and the documentation follow it."""

from __future__ import annotations

import re
import runpy
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from endopilot import _core
from endopilot.dataset.loader import Dataset
from endopilot.dataset.schema import OWN_COLUMNS, STATE
from endopilot.simulation.signals import SIGNALS, Outputs, table_columns
from endopilot.simulation.trajectory import Step, Trajectory, trajectory_table
from toy_evaluation import make_trajectory

RECORDED = {name: (of, numbers) for name, of, numbers, *_ in _core.OUTPUTS if of in ("device", "sample")}


def test_a_step_has_each_output_of_the_core_with_its_axes() -> None:
    types: dict[str, Any] = {each.name: each.type for each in fields(Step)}
    declared = {name: each.dim_str for name, each in types.items()}
    axes = {"device": "*each devices", "sample": "*each"}
    assert declared == {name: axes[of] + (f" {n}" if n > 1 else "") for name, (of, n) in RECORDED.items()}
    assert set(declared) <= {each.name for each in fields(Trajectory)}


def test_every_output_is_described_and_has_its_columns_in_tables_and_in_data_sets() -> None:
    table = trajectory_table(make_trajectory())
    for name in RECORDED:
        assert f"\n        {name}: {SIGNALS[name].meaning}" in (Trajectory.__doc__ or ""), name
        assert SIGNALS[name].columns and set(SIGNALS[name].columns) <= set(table.columns), name
    stored = {name for name, *_ in OWN_COLUMNS.values()} | set(STATE)
    assert stored >= {each.name for each in fields(Outputs)}
    columns = [column for each in SIGNALS.values() for column in each.columns]
    assert len(columns) == len(set(columns))


@pytest.mark.parametrize("kind", [Dataset, Trajectory])
def test_no_attribute_is_described_twice(kind) -> None:
    named = re.findall(r"^ {8}(\w+): ", kind.__doc__, re.MULTILINE)
    assert "valid" in named and len(named) == len({*named})


def test_columns_of_devices_come_one_device_after_the_other() -> None:
    position, force = np.arange(12.0).reshape(2, 2, 3), np.array([0.1, 0.2])
    found = table_columns({"wall_force": force, "tip_position": position})
    assert list(found) == [
        *(f"tip_{axis}_mm" for axis in "xyz"),
        *(f"catheter_1_tip_{axis}_mm" for axis in "xyz"),
        "wall_force_n",
    ]
    np.testing.assert_array_equal(found["catheter_1_tip_y_mm"], position[:, 1, 1])


def test_further_signals_are_columns_of_a_table_by_their_rows_or_their_own_name() -> None:
    made = make_trajectory(2)
    further = {"believed": np.arange(4.0).reshape(1, 2, 2), "mine": np.array([[5.0, 6.0]])}
    table = trajectory_table(replace(made, columns=further))
    expected = {"believed_tip_abscissa_mm": [0, 2], "believed_tip_offset_mm": [1, 3], "mine": [5, 6]}
    found = pd.DataFrame({name: table[name] for name in expected})
    pd.testing.assert_frame_equal(found, pd.DataFrame(expected, dtype=float))


def test_the_documentation_lists_the_signals() -> None:
    script = Path(__file__).parents[2] / "docs/signals.py"
    made = runpy.run_path(str(script))
    assert made["PAGE"].read_text(encoding="utf-8") == made["page"]()
