"""The core's tables: what a run records, and its settings."""

from __future__ import annotations

import navigations

from endopilot import _core


def test_a_run_records_what_the_table_of_outputs_lists() -> None:
    recorded = navigations.navigate("velocity", 1)
    each = (navigations.WORLDS, navigations.SAMPLES)
    shapes = {"sample": each, "device": (*each, 1), "start": (navigations.WORLDS, 1)}
    for name, of, numbers, _, meaning in _core.OUTPUTS:
        assert meaning, name
        if of == "element":  # which are not asked for
            assert name not in recorded
            continue
        shape = shapes.get(of, (*each, recorded["contacts"].shape[1]))
        assert recorded[name].shape == (shape if numbers == 1 else (*shape, numbers)), name
    assert set(recorded) - {name for name, *_ in _core.OUTPUTS} == {"reason", "contacts"}


def test_the_table_of_options_lists_the_settings() -> None:
    options = _core.Options()
    for name, kind, _, meaning in _core.OPTIONS:
        setattr(options, name, 3)
        assert meaning and type(getattr(options, name)).__name__ == kind, name
    assert {name for name in dir(_core.Options) if not name.startswith("_")} == {name for name, *_ in _core.OPTIONS}
