"""Settings classes that check themselves, and the files that hold them.

`@settings` makes a frozen, keyword-only dataclass whose fields pydantic validates:

    @settings
    class RodConfig:
        friction: NonNegative = 0.1
        element_mm: Annotated[float, Within(0.02, 5)] = 0.75

A bad value raises `InputError` in one line: the field, its value, and what to give instead. A check of several fields
is a `pydantic.model_validator(mode="after")` that raises `ValueError("field: value; what to give")`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)  # fmt: skip

import numpy as np
from pydantic import AfterValidator, ConfigDict, GetCoreSchemaHandler, StringConstraints, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from endopilot.errors import InputError
from endopilot.files import read_json, read_yaml

_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")
T = TypeVar("T")
Number = int | float
_STRICT = ConfigDict(extra="forbid")
_UNKNOWN = ("unexpected_keyword_argument", "extra_forbidden")
_MENDS = {
    "string_type": "give text",
    "string_too_short": "give some text",
    "bool_type": "give true or false",
    "bool_parsing": "give true or false",
    "tuple_type": "give a list of values",
    "path_type": "give a path",
    "dict_type": "give a mapping of names and values",
    "too_short": "give at least {min_length} values",
    "too_long": "give {max_length} values",
    "literal_error": "choose from {expected}",
    "is_instance_of": "give a {class}",
}
"""What to give instead, by pydantic's kind of error."""


@dataclasses.dataclass(frozen=True)
class Within:
    """The range of a number, as an annotation of `int` (whole numbers alone) or `float` (finite numbers).

    Attributes:
        above_low: whether `low` itself is refused; `below_high` likewise.
        unit: of the number, such as "mm".
        mistaken: other units that it may have been given in by mistake: name, and size in `unit`.
    """

    low: Number = -math.inf
    high: Number = math.inf
    above_low: bool = False
    below_high: bool = False
    unit: str = ""
    mistaken: tuple[tuple[str, float], ...] = ()

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema that pydantic checks by; all that it refuses is answered by one sentence."""
        low, high = ("gt" if self.above_low else "ge"), ("lt" if self.below_high else "le")
        bounds: dict[str, Any] = {
            name: bound for name, bound in ((low, self.low), (high, self.high)) if math.isfinite(bound)
        }
        if source is int:
            number: CoreSchema = core_schema.int_schema(strict=True, **bounds)
        else:
            number = core_schema.float_schema(strict=True, allow_inf_nan=False, **bounds)

        def check(value: Any, checked: Callable[[Any], Any]) -> Any:
            value = _without_numpy(value)
            try:
                return checked(value)
            except ValidationError:
                mend = self.mend(whole=source is int) + self.proposal(value)
                raise PydanticCustomError("range", "{mend}", {"mend": mend}) from None

        return core_schema.no_info_wrap_validator_function(check, number)

    def proposal(self, value: Any) -> str:
        """Return what a refused value may have been meant as, in parentheses; nothing if no unit makes sense of it."""
        if isinstance(value, str):
            plain = value.strip().replace(",", ".", 1)
            return f" ({value} with a decimal point is {plain})" if _DECIMAL_COMMA.fullmatch(value.strip()) else ""
        if type(value) not in (int, float) or not math.isfinite(value):
            return ""
        for name, size in self.mistaken:
            if value and self.low <= value * size <= self.high:
                return f" ({value:g} {name} is {value * size:.4g} {self.unit})"
        return ""

    def mend(self, *, whole: bool) -> str:
        """Return what to give, in words; `whole` says whether it must be a whole number."""
        number, low, high = ("whole number" if whole else "number"), _bound(self.low), _bound(self.high)
        unit = f" {self.unit}" if self.unit else ""
        if math.isfinite(self.low) and math.isfinite(self.high):
            if self.above_low and self.below_high:
                return f"give a {number} between {low} and {high}{unit}"
            if self.above_low:
                return f"give a {number} above {low}, at most {high}{unit}"
            return f"give a {number} from {low} to {'below ' if self.below_high else ''}{high}{unit}"
        if math.isfinite(self.low):
            if not self.above_low:
                return f"give a {number} of {low}{unit} or more"
            return f"give a positive {number}" if self.low == 0 else f"give a {number} above {low}{unit}"
        if math.isfinite(self.high):
            return f"give a {number} {'below' if self.below_high else 'of at most'} {high}{unit}"
        return f"give a {number}" if whole else "give a finite number"


def _ascending(pair: tuple[Number, Number]) -> tuple[Number, Number]:
    if not pair[0] <= pair[1]:
        raise PydanticCustomError("range", "give two numbers, the smaller first")
    return pair


Finite = Annotated[float, Within()]  # any finite number
Positive = Annotated[float, Within(0, above_low=True)]  # a number above 0
NonNegative = Annotated[float, Within(0)]  # a number of 0 or more
Share = Annotated[float, Within(0, 1)]  # a number from 0 to 1
OpenShare = Annotated[float, Within(0, 1, above_low=True, below_high=True)]  # between 0 and 1, neither included
ShareBelowOne = Annotated[float, Within(0, 1, below_high=True)]  # a number from 0 to below 1
Count = Annotated[int, Within(1, 10**6)]  # from 1 to a million; more would run for ever or take all memory
CountOrZero = Annotated[int, Within(0, 10**6)]  # a whole number from 0 to a million
LONGEST_S = 86_400.0  # longest time that anything is simulated for, s: a day
Seconds = Annotated[float, Within(0, LONGEST_S, above_low=True)]  # a time above 0, at most a day, s
Seed = Annotated[int, Within(0, 2**64 - 1)]  # seed of a random stream
Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]  # text that is not empty
Ascending = AfterValidator(_ascending)  # annotation of a pair of numbers: the first is not above the second


@overload
@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T], /) -> type[T]: ...


@overload
@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(*, eq: bool) -> Callable[[type[T]], type[T]]: ...


def settings(cls: type[T] | None = None, /, *, eq: bool = True) -> Any:
    """Make a class of annotated fields a frozen, keyword-only dataclass that checks them.

    Its construction raises `InputError`, in one line that names the field, its value and what to give instead. It takes
    mappings for fields that are settings classes themselves, and lists for tuples, as JSON and YAML files have them.
    With `eq`, instances of equal fields are equal.
    """
    if cls is None:
        return lambda decorated: _made(decorated, eq)
    return _made(cls, eq)


def is_settings(cls: Any) -> bool:
    """Return whether something is a class made by `settings`."""
    return isinstance(cls, type) and hasattr(cls, "__pydantic_fields__")


def from_record(cls: type[T], record: Any, *, onto: T | None = None) -> T:
    """Return settings from the names and values of their fields, as `dataclasses.asdict` or a file gives them.

    `onto` holds the fields which are not there; without it all must be there but those that are None by default. Raises
    InputError, in a line that names field, value and what to give instead.
    """
    if not isinstance(record, Mapping) or not all(isinstance(name, str) for name in record):
        raise InputError(f"holds no mapping of fields; the fields are {', '.join(_fields(cls))}")
    read = cls(**record) if onto is None else cls(**_onto(onto, record))
    for field in dataclasses.fields(cast(Any, cls)):
        if onto is None and field.name not in record and field.default is not None:
            raise InputError(f"{field.name}: missing; add it")
    return read


def read_settings(path: Path, cls: type[T], *, onto: T | None = None, remedy: str = "") -> T:
    """Read settings from a JSON file (by its suffix) or a YAML file, as `from_record` has it; `remedy` is what else to
    do about a bad file, such as "run `endopilot advise` again"."""
    content = read_json(path) if Path(path).suffix.lower() == ".json" else read_yaml(path)
    try:
        return from_record(cls, content, onto=onto)
    except InputError as error:
        raise InputError(f"{path}: {error}{', or ' if remedy else ''}{remedy}") from None


def _onto(values: Any, record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of settings with those of a record in their place, settings within them likewise."""
    fields = {name: getattr(values, name) for name in _fields(type(values))} | dict(record)
    for name in record:
        old = getattr(values, name, None)
        if is_settings(type(old)) and isinstance(record[name], Mapping):
            fields[name] = _onto(old, record[name])
    return fields


def _made(cls: type[T], eq: bool) -> type[T]:
    made: Any = dataclass(frozen=True, kw_only=True, eq=eq, config=_STRICT)(cls)
    validate = made.__init__

    @wraps(validate)
    def init(self: Any, **values: Any) -> None:
        try:
            validate(self, **values)
        except ValidationError as error:
            raise InputError(_sentence(made, error)) from None

    made.__init__ = init
    return made


def _sentence(cls: type, error: ValidationError) -> str:
    """Return the one line about the worst of pydantic's errors: an unknown field, else the first."""
    problem = min(error.errors(include_url=False), key=lambda found: found["type"] not in _UNKNOWN)
    kind, place, context = problem["type"], problem["loc"], problem.get("ctx", {})
    if kind == "value_error":
        return f"{_path(place)}{'.' if place else ''}{context['error']}"
    if kind in _UNKNOWN:
        known = _fields_at(cls, place[:-1])
        near = difflib.get_close_matches(str(place[-1]), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"the fields are {', '.join(known)}"
        return f"{_path(place)}: no such field; {hint}"
    if kind.startswith("missing"):
        if isinstance(place[-1], int):
            return f"{_path(place[:-1])}: {_shown(problem)}; give more values"
        return f"{_path(place)}: missing; add it"
    if kind == "dataclass_type":
        mend = "write it as {" + ", ".join(f"{name}: ..." for name in _fields_at(cls, place)) + "}"
    elif kind == "range":
        mend = problem["msg"]
    else:
        mend = _MENDS[kind].format(**context) if kind in _MENDS else f"correct it ({problem['msg']})"
    return f"{_path(place)}: {_shown(problem)}; {mend}"


def _shown(problem: ErrorDetails) -> str:
    value = problem["input"]
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _path(place: Sequence[int | str]) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")


def _fields(cls: type) -> list[str]:
    return list(getattr(cls, "__pydantic_fields__", ()))


def _fields_at(cls: Any, place: Sequence[int | str]) -> list[str]:
    for part in place:
        if not isinstance(part, int) and part not in getattr(cls, "__pydantic_fields__", {}):
            return []
        inner = cls if isinstance(part, int) else cls.__pydantic_fields__[part].annotation
        kinds = (get_origin(kind) or kind for kind in (inner, *get_args(inner)))
        cls = next((kind for kind in kinds if _fields(kind)), inner)
    return _fields(cls)


def _bound(value: Number) -> str:
    if isinstance(value, int):
        return f"2^{value.bit_length()} - 1" if value >= 2**32 else str(value)
    return f"{value:.10g}"


def _without_numpy(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


_MADE_BY = {
    "Anatomy": " (endopilot.read_anatomy, extract_anatomy)",
    "LumenMask": "(Volume(voxels, spacing_mm, origin_mm, direction))",
    "Volume": " (endopilot.read_volume)",
    "Wire": " (endopilot.read_wire)",
}
"""What makes an object where its constructor's name does not say so."""


def public(function: Callable[..., T]) -> Callable[..., T]:
    """Make a function check the kinds of its arguments by their annotations, before it does anything; InputError says
    which are taken, and what makes them. Lists of numbers become arrays, and NumPy's numbers plain ones. What an
    annotation says of shapes is not checked."""
    signature, hints_of = inspect.signature(function), cache(get_type_hints)

    @wraps(function)
    def checked(*given: Any, **named: Any) -> T:
        bound, hints = signature.bind(*given, **named), hints_of(function)
        for name, value in bound.arguments.items():
            bound.arguments[name] = _of_kind(name, value, hints[name]) if name in hints else value
        return function(*bound.args, **bound.kwargs)

    return checked


def _of_kind(name: str, value: Any, hint: Any) -> Any:
    """Return an argument as one of the kinds that its annotation names."""
    value, words = _without_numpy(value), []
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for kind in (get_args(each)[0] if get_origin(each) is Annotated else each for each in kinds):
        cls = get_origin(kind) or kind
        if cls is Literal:
            fits, said = value in get_args(kind), f"one of {', '.join(map(repr, get_args(kind)))}"
        elif hasattr(kind, "array_type"):  # as jaxtyping has it
            if isinstance(value, list | tuple):
                with contextlib.suppress(ValueError, TypeError):
                    return np.array(value, dtype=float)
            fits, said = isinstance(value, np.ndarray), f"an array of {kind.dim_str}"
        else:
            wanted = (int, float) if cls is float else cls
            is_text = cls is Sequence and isinstance(value, str)
            fits = not isinstance(cls, type) or (isinstance(value, wanted) and not is_text)
            said = {str: "text", Path: "a path", float: "a number"}.get(cls, getattr(cls, "__name__", str(cls)))
            said += f" of {getattr(get_args(kind)[0], '__name__', get_args(kind)[0])}" if cls is Sequence else ""
            said += _MADE_BY.get(said, "")
        if fits:
            return value
        words += [] if cls is NoneType else [said]
    shown = repr(value) if isinstance(value, str | int | float) else f"of type {type(value).__name__}"
    example = f", such as {str(value)!r}" if isinstance(value, int) and words == ["text"] else ""
    raise InputError(f"{name}: {shown}; give {' or '.join(words)}{example}")
