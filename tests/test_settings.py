"""Every settings class of the package, found by introspection, and the machinery that checks them."""

from __future__ import annotations

import importlib
import json
import math
import pickle
import pkgutil
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, fields, is_dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from pydantic import model_validator

import endopilot
from endopilot.devices.device import Wire, read_wire
from endopilot.errors import InputError
from endopilot.files import json_text
from endopilot.settings import Ascending, Count, Finite, NonNegative, Positive, Within, from_record, read_settings
from endopilot.settings import settings as settings_class

ENDLESS = {("DriveLimits", "travel_mm[1]")}
"""Numbers that may be infinite."""
MEASURED = {("NavigationEntry", place) for place in ("seconds", "path_ratio", "peak_force_n")}
"""Results, which may be NaN."""


@settings_class
class Rod:
    """A rod."""

    radius_mm: Positive = 0.2
    """Radius, mm."""
    nodes: Annotated[int, Within(2, 500)] = 10
    material: Literal["nitinol", "steel"] = "steel"
    bend_mm: Annotated[tuple[NonNegative, NonNegative], Ascending] = (0.0, 3.0)
    points: tuple[tuple[Finite, Finite], ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Rod:
        if self.nodes % 2:
            raise ValueError(f"nodes: {self.nodes}; give an even number")
        return self


@settings_class
class Tie:
    """What holds a bundle."""

    knots: Count = 1


@settings_class
class Bundle:
    """A bundle of rods."""

    rod: Rod
    count: Count
    tie: Tie | None = None


def package_classes() -> list[type]:
    """Return every class that the package defines."""
    found: set[type] = set()
    for module in pkgutil.walk_packages(endopilot.__path__, "endopilot."):
        if module.name.endswith("__main__"):
            continue
        names = vars(importlib.import_module(module.name)).values()
        found |= {kind for kind in names if isinstance(kind, type) and kind.__module__ == module.name}
    return sorted(found, key=lambda kind: (kind.__qualname__, kind.__module__))  # the same in every process


def is_settings(kind: type) -> bool:
    return is_dataclass(kind) and "__pydantic_fields__" in vars(kind)


CLASSES = package_classes()
SETTINGS = [kind for kind in CLASSES if is_settings(kind) and not getattr(kind, "__parameters__", ())]


def numbers(hint: Any, place: str) -> Iterator[tuple[str, type, Within | None, Callable[[Any], Any]]]:
    """Yield each number in a field of some type: place, type, range, and what makes a value that holds another."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in (int, float):
        yield place, hint, None, lambda value: value
    elif origin is Annotated and arguments[0] in (int, float):
        yield place, arguments[0], range_of(hint), lambda value: value
    elif origin is Annotated:
        yield from numbers(arguments[0], place)
    elif origin in (Union, UnionType):
        for kind in arguments:
            yield from numbers(kind, place)
    elif origin in (tuple, Sequence):
        parts = [arguments[0]] * 4 if origin is Sequence or arguments[-1] is Ellipsis else list(arguments)
        for i, part in enumerate(parts):
            for inner, number, within, put in numbers(part, f"{place}[{i}]"):
                yield inner, number, within, partial(put_into, [valid(other) for other in parts], i, put)


def put_into(values: list[Any], i: int, put: Callable[[Any], Any], value: Any) -> tuple[Any, ...]:
    return (*values[:i], put(value), *values[i + 1 :])


def range_of(hint: Any) -> Within:
    return next(part for part in get_args(hint)[1:] if isinstance(part, Within))


UNBOUNDED = {"Wire", "Catheter", "DriveLimits"}
"""What code gives in the units that it likes; files hold them within the ranges of `device_files`."""


def test_no_number_that_a_user_gives_is_large_enough_to_run_for_ever() -> None:
    """Counts, times, steps and sizes have bounds: a typing error is refused before the work begins."""
    drives = r"(^|[^mdn])_s$|seconds|_period_s|spacing|slice|pixel_mm|in_plane"  # lengths of time, and voxels
    loose = {
        f"{kind.__name__}.{place}"
        for kind, _, place, number, within, _ in (case.values for case in cases())
        if kind.__name__ not in UNBOUNDED
        if number is int or re.search(drives, place)
        if within is not None and not math.isfinite(within.high)
    }
    assert loose == set()


def holds(within: Within, value: float) -> bool:
    above = value > within.low if within.above_low else value >= within.low
    return above and (value < within.high if within.below_high else value <= within.high)


def valid(hint: Any) -> Any:
    """Return a value that a field of some type takes by itself."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in (int, float):
        return hint(1)
    if origin is Annotated and arguments[0] in (int, float):
        return arguments[0](next(v for v in (1, 0.5, range_of(hint).low) if holds(range_of(hint), v)))
    if origin is Annotated:
        return valid(arguments[0])
    if origin in (Union, UnionType):
        return valid(arguments[0])
    if origin in (tuple, Sequence):
        parts = [arguments[0]] * 4 if origin is Sequence or arguments[-1] is Ellipsis else arguments
        return tuple(valid(part) for part in parts)
    if origin is Literal:
        return arguments[0]
    if origin is not None and issubclass(origin, Mapping):
        return {}
    if hint is Wire:
        return read_wire("workhorse-014")
    if is_settings(hint):
        return hint(**{name: valid(hints_of(hint)[name]) for name in required(hint)})
    return hint() if hint is bool else "text" if hint is str else object.__new__(hint)


def required(kind: type) -> set[str]:
    return {field.name for field in fields(kind) if field.default is field.default_factory is MISSING}


def hints_of(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def cases() -> list[Any]:
    """Return class, field, place, type, range and setter of every number in every settings class."""
    return [
        pytest.param(kind, field.name, place, number, within, put, id=f"{kind.__name__}.{place}")
        for kind in SETTINGS
        for field in fields(kind)
        for place, number, within, put in numbers(hints_of(kind)[field.name], field.name)
        if (kind.__name__, place) not in MEASURED
    ]


def test_settings_are_found() -> None:
    names = {kind.__name__ for kind in SETTINGS}
    assert {"SimulatorConfig", "PlanConfig", "TrainConfig", "DatasetConfig", "PhantomConfig", "Calibration"} <= names
    assert len(cases()) > 150


def test_all_configurations_are_settings() -> None:
    assert [kind.__name__ for kind in CLASSES if kind.__name__.endswith("Config") and not is_settings(kind)] == []


@pytest.mark.parametrize(("kind", "field", "place", "number", "within", "put"), cases())
def test_every_number_has_a_range_and_refuses_what_lies_outside(kind, field, place, number, within, put) -> None:
    others = {name: valid(hints_of(kind)[name]) for name in required(kind) - {field}}
    if (kind.__name__, place) in ENDLESS:
        with pytest.raises(InputError, match=rf"^{field}: .*nan"):
            kind(**others, **{field: put(math.nan)})
        return
    assert within is not None, f"{kind.__name__}.{place} has no range; annotate it with one"
    bad: list[Any] = [math.nan, math.inf, -math.inf, "1", True, *([1.5] if number is int else [])]
    step = 1 if number is int else 1e-6
    if math.isfinite(within.low):
        bad.append(number(within.low if within.above_low else within.low - step))
    if math.isfinite(within.high):
        bad.append(number(within.high if within.below_high else within.high + step))
    for value in bad:
        with pytest.raises(InputError) as error:
            kind(**others, **{field: put(value)})
        assert str(error.value).startswith(f"{place}: {value!r}; give a ")


ONE_OF_TWO = {"CArmCamera": {"angles_deg": (0.0, 0.0), "isocenter_mm": (0.0, 0.0, 0.0), "centre_px": (256.0, 256.0)}}
"""Settings that are given in one way or another, each with one of these."""


@pytest.mark.parametrize("kind", [kind for kind in SETTINGS if not required(kind)], ids=lambda kind: kind.__name__)
def test_defaults_are_valid_and_settings_survive_records_copies_and_processes(kind: type) -> None:
    made = kind(**ONE_OF_TWO.get(kind.__name__, {}))
    record = json.loads(json_text(asdict(made)))
    assert from_record(kind, record) == made
    assert replace(made) == made and hash(replace(made)) == hash(made)
    assert pickle.loads(pickle.dumps(made)) == made


@pytest.mark.parametrize(
    ("within", "whole", "words"),
    [
        (Within(), False, "give a finite number"),
        (Within(), True, "give a whole number"),
        (Within(0, above_low=True), False, "give a positive number"),
        (Within(1), True, "give a whole number of 1 or more"),
        (Within(0, 1, above_low=True, below_high=True), False, "give a number between 0 and 1"),
        (Within(0, 1, below_high=True), False, "give a number from 0 to below 1"),
        (Within(0, 1, above_low=True), False, "give a number above 0, at most 1"),
        (Within(2, above_low=True), False, "give a number above 2"),
        (Within(0, 2**64 - 1), True, "give a whole number from 0 to 2^64 - 1"),
        (Within(high=3), False, "give a number of at most 3"),
        (Within(high=3, below_high=True), False, "give a number below 3"),
    ],
)
def test_ranges_are_put_in_words(within: Within, whole: bool, words: str) -> None:
    assert within.mend(whole=whole) == words


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"radius": 1.0}, "radius: no such field; did you mean radius_mm?"),
        ({"colour": 1}, "colour: no such field; the fields are radius_mm, nodes, material, bend_mm, points"),
        (
            {"radius_mm": -1, "colour": 1},
            "colour: no such field; the fields are radius_mm, nodes, material, bend_mm, points",
        ),
        ({"material": "glass"}, "material: 'glass'; choose from 'nitinol' or 'steel'"),
        ({"nodes": 11}, "nodes: 11; give an even number"),
        ({"bend_mm": (2, 1)}, "bend_mm: (2, 1); give two numbers, the smaller first"),
        ({"bend_mm": (2,)}, "bend_mm: (2,); give more values"),
        ({"bend_mm": (1, 2, 3)}, "bend_mm: (1, 2, 3); give 2 values"),
        ({"bend_mm": 2}, "bend_mm: 2; give a list of values"),
        ({"points": [[1, 2], [1, math.nan]]}, "points[1][1]: nan; give a finite number"),
        ({"radius_mm": "x" * 200}, f"radius_mm: '{'x' * 76}...; give a positive number"),
    ],
)
def test_a_bad_value_is_named(values: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as error:
        Rod(**values)
    assert str(error.value) == line


@pytest.mark.parametrize(
    ("record", "line"),
    [
        ({"rod": {"radius_mm": 0}, "count": 1}, "rod.radius_mm: 0; give a positive number"),
        ({"rod": {"nodes": 11}, "count": 1}, "rod.nodes: 11; give an even number"),
        ({"rod": {"nodez": 11}, "count": 1}, "rod.nodez: no such field; did you mean nodes?"),
        (
            {"rod": 3, "count": 1},
            "rod: 3; write it as {radius_mm: ..., nodes: ..., material: ..., bend_mm: ..., points: ...}",
        ),
        ({"rod": {}}, "count: missing; add it"),
        (
            {"rod": {"radius_mm": "0,36"}, "count": 1},
            "rod.radius_mm: '0,36'; give a positive number (0,36 with a decimal point is 0.36)",
        ),
        ([1], "holds no mapping of fields; the fields are rod, count, tie"),
        ({1: 2}, "holds no mapping of fields; the fields are rod, count, tie"),
    ],
)
def test_a_bad_record_is_named_with_the_path_of_its_field(record: Any, line: str) -> None:
    with pytest.raises(InputError) as error:
        from_record(Bundle, record)
    assert str(error.value) == line


def test_a_record_must_name_every_field() -> None:
    with pytest.raises(InputError, match=r"^nodes: missing; add it$"):
        from_record(Rod, {name: value for name, value in asdict(Rod()).items() if name != "nodes"})


def test_numbers_of_numpy_become_plain_ones() -> None:
    rod = Rod(radius_mm=np.float32(0.5), nodes=np.int64(4), bend_mm=(np.float64(0.0), 1))
    assert (rod.radius_mm, rod.nodes, rod.bend_mm) == (0.5, 4, (0.0, 1.0))
    assert [type(value) for value in (rod.radius_mm, rod.nodes, *rod.bend_mm)] == [float, int, float, float]


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_a_file_is_read_and_its_faults_are_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"bundle{suffix}"
    path.write_text('{"rod": {"bend_mm": [1, 2]}, "count": 3, "tie": null}')
    assert read_settings(path, Bundle) == Bundle(rod=Rod(bend_mm=(1.0, 2.0)), count=3)
    path.write_text('{"rod": {}, "count": 0}')
    with pytest.raises(InputError) as error:
        read_settings(path, Bundle, remedy="tie it again")
    assert str(error.value) == f"{path}: count: 0; give a whole number from 1 to 1000000, or tie it again"
    path.write_text("{")
    with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: .*not valid {suffix[1:].upper()}"):
        read_settings(path, Bundle)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_settings(path, Bundle)
    with pytest.raises(InputError, match="no such file"):
        read_settings(tmp_path / f"none{suffix}", Bundle)


@pytest.mark.parametrize(
    "name",
    [
        *("calibrate", "extract_anatomy", "locate", "make_phantom", "navigate", "plan"),
        *("read_anatomy", "read_robot", "read_trajectory", "read_volume", "read_wire"),
        *("replay_log", "segment", "simulate", "take_image", "write_anatomy"),
    ],
)
def test_a_public_function_refuses_what_is_of_no_kind_that_it_takes(name: str) -> None:
    function = getattr(endopilot, name)
    needed = [one for one in signature(function).parameters.values() if one.default is one.empty]
    places = [object() for one in needed if one.kind is not one.KEYWORD_ONLY]
    named = {one.name: object() for one in needed if one.kind is one.KEYWORD_ONLY}
    with pytest.raises(InputError, match=rf"^{needed[0].name}: of type object; give \w+"):
        function(*places, **named)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: endopilot.extract_anatomy(np.ones((9, 9, 9))), r"source: of type ndarray; give .*LumenMask\(Volume\("),
        (lambda: endopilot.navigate("patient", 2), "target: 2; give text, such as '2'"),
        (lambda: endopilot.plan("patient", np.int64(7)), "target: 7; give text, such as '7'"),
        (lambda: endopilot.plan("patient", "2", config={"seconds": 3}), "config: of type dict; give PlanConfig"),
        (lambda: endopilot.take_image("patient"), "anatomy: 'patient'; give Anatomy .endopilot.read_anatomy, extract"),
        (lambda: endopilot.read_trajectory("r.npz", anatomy="patient"), "anatomy: 'patient'; give Anatomy"),
    ],
)
def test_what_a_public_function_takes_instead_is_told(call: Callable[[], Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        call()
