"""The names of `import endopilot`: all are there, documented, and imported no sooner than they are used."""

from __future__ import annotations

import dataclasses
import inspect
import re
import subprocess
import sys
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import endopilot
from endopilot.tasks.targets import Place

ROOT = Path(__file__).parents[1]
LARGE = {
    "SimpleITK", "gymnasium", "jinja2", "matplotlib", "numpy", "pandas", "plotly", "pyarrow", "pydantic", "pydicom",
    "pyvista", "scipy", "skimage", "torch", "vtk", "vtkmodules", "yaml",
}  # fmt: skip
SLOW = {"Axes": Axes, "Figure": Figure, "Place": Place, "Target": endopilot.Target}
"""What a module imports only to be type-checked."""
ASKED = {
    "Anatomy", "read_anatomy", "extract_anatomy", "segment", "Wire", "read_wire", "Simulator", "simulate", "plan",
    "make_atlas", "generate_dataset", "train", "load_model", "navigate", "evaluate", "InputError", "read_volume",
}  # fmt: skip


VERBS = {
    "assess", "calibrate", "check", "climb", "evaluate", "extract", "find", "generate", "list", "load", "locate",
    "make", "navigate", "plan", "read", "replay", "segment", "simulate", "take", "train", "write",
}  # fmt: skip
SUBJECTS = {
    "anatomies", "anatomy", "control", "dataset", "device", "devices", "driven", "folder", "locations", "logs", "name",
    "name_or_path", "navigation", "num_envs", "path", "plan", "policy", "run", "session", "source", "target", "version",
    "volume", "wire", "wire_radius_mm",
}  # fmt: skip
"""What a function does something with, or to. All else goes by keyword."""
UNITS = re.compile(r"(^|_)(mm2?|s2?|n|hu|rad|deg|px|ugy|seconds|pixel_sd|along_sd|share|factor|weight|ratio)$")
WITHOUT_UNIT = {
    "calcium", "dose", "efficiency", "friction", "friction_along", "gain_rotation", "gain_sd_rotation",
    "gain_sd_translation", "gain_translation", "largest_jump", "learning_rate", "right_heart", "scale",
    "scatter", "temperature", "wall_along", "wall_around", "window", "zoom",
}  # fmt: skip


def imported_by(code: str) -> set[str]:
    """Return which large libraries a fresh process has imported after some code."""
    code = f"import sys\n{code}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return LARGE & set(result.stdout.split())


def test_the_import_brings_no_library() -> None:
    assert imported_by("import endopilot; endopilot.__version__; dir(endopilot)") == set()


def test_the_rod_core_brings_no_large_library() -> None:
    code = "from endopilot import Simulator, read_anatomy, read_wire, simulate"
    assert imported_by(code) <= {"numpy", "scipy", "yaml", "pydantic"}


def test_every_name_is_there_and_documented() -> None:
    assert set(endopilot.__all__) <= set(dir(endopilot))
    assert set(endopilot.__all__) >= ASKED
    for name in endopilot.__all__:
        thing = getattr(endopilot, name)
        assert inspect.getdoc(thing), name
        assert thing.__module__.startswith("endopilot."), name


def test_the_reference_describes_exactly_these_names() -> None:
    page = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "docs" / "reference").glob("*.md"))
    described = re.findall(r"^\.\. auto(?:function|class|exception):: (\w+)$", page, re.MULTILINE)
    assert sorted(described) == sorted(endopilot.__all__)


def types_of(annotation: object) -> Iterator[type]:
    """Yield the classes that an annotation is made of."""
    if inspect.isclass(annotation) and not isinstance(annotation, types.GenericAlias):
        yield annotation
    for part in () if typing.get_origin(annotation) is typing.Literal else typing.get_args(annotation):
        for each in part if isinstance(part, list) else (part,):
            yield from types_of(each)


def annotations_of(thing: Any, name: str) -> Iterator[tuple[str, object]]:
    """Yield what a function takes and returns, or what a class's public attributes and methods are, by name."""
    own = {
        field: each
        for field, each in inspect.get_annotations(thing, locals=SLOW, eval_str=True).items()
        if field[0] != "_"
    }
    yield from ((f"{name}.{field}", each) for field, each in own.items() if field[0] != "_")
    for field, member in vars(thing).items() if inspect.isclass(thing) else ():
        if field.startswith("_") and field not in ("__init__", "__call__"):
            continue
        for holder in ("__func__", "fget", "func", "__wrapped__"):  # of a class method, properties, a decorator
            member = getattr(member, holder, member)
        if inspect.isfunction(member) and member.__globals__["__name__"].startswith("endopilot."):
            yield from annotations_of(member, f"{name}.{field}")
    for base in thing.__bases__ if inspect.isclass(thing) else ():
        if base.__module__.startswith("endopilot."):
            yield from annotations_of(base, name)


def test_every_type_in_a_public_signature_is_public() -> None:
    public = {name: getattr(endopilot, name) for name in endopilot.__all__}
    hidden = {
        f"{where}: {each.__module__}.{each.__name__}"
        for name, thing in public.items()
        for where, annotation in annotations_of(thing, name)
        for each in types_of(annotation)
        if each.__module__.startswith("endopilot.") and each not in public.values()
    }
    assert not hidden


def public_calls() -> Iterator[tuple[str, inspect.Signature]]:
    """Yield the public functions, and the classes that are made by an `__init__` of their own."""
    for name in endopilot.__all__:
        thing = inspect.unwrap(getattr(endopilot, name))
        made = inspect.isclass(thing) and inspect.isfunction(vars(thing).get("__init__"))
        fields = dataclasses.is_dataclass(thing) or getattr(thing, "_is_protocol", False)
        if inspect.isfunction(thing) or (made and not fields):
            yield name, inspect.signature(thing)


CALLS = dict(public_calls())


@pytest.mark.parametrize("name", CALLS)
def test_a_public_function_is_a_verb_with_subjects_and_keywords(name: str) -> None:
    if name[0].islower():
        assert name.partition("_")[0] in VERBS
    for parameter in CALLS[name].parameters.values():
        by_keyword = parameter.kind in (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.VAR_KEYWORD)
        assert by_keyword or parameter.name in SUBJECTS, f"{parameter.name}: not by keyword alone"
        if parameter.name in ("config", "output", "seed"):
            assert by_keyword
        if parameter.name == "output":
            assert parameter.default is inspect.Parameter.empty and parameter.annotation == "str | Path"
        if parameter.name == "config" and name[0].islower():
            assert re.fullmatch(r"\w+Config \| None", parameter.annotation) and parameter.default is None


def test_a_file_is_read_and_a_trained_model_loaded() -> None:
    assert [name for name in CALLS if name.startswith("load_")] == ["load_model"]
    for name in endopilot.__all__:  # a load that is no function is a force and a torque
        assert not any(callable(getattr(getattr(endopilot, name), verb, None)) for verb in ("load", "save"))


def test_parameters_of_one_name_take_one_kind_of_thing() -> None:
    takes: dict[str, list[tuple[str, set[str]]]] = {}
    for name, signature in CALLS.items():
        for parameter in signature.parameters.values():
            kinds = set(re.findall(r"\w+", parameter.annotation)) - {"None", "Sequence"}
            takes.setdefault(parameter.name, []).append((name, kinds))
    for parameter, uses in takes.items():
        first, kinds = uses[0]
        for name, others in uses if parameter != "config" else ():
            assert kinds & others, f"{parameter}: {first} takes {kinds}, {name} takes {others}"


def test_numbers_of_settings_name_their_units() -> None:
    silent = {
        f"{name}.{field.name}"
        for name in endopilot.__all__
        if name.endswith("Config")
        for field in dataclasses.fields(getattr(endopilot, name))
        if re.search(r"float\b|Positive|NonNegative|Finite", str(field.type))
        and field.name not in WITHOUT_UNIT | {"seeds", "precision"}
        and not UNITS.search(field.name)
    }
    assert not silent


def test_another_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        _ = endopilot.nonsense  # pyright: ignore[reportAttributeAccessIssue]
