"""A command's options: its flags, its settings file and its help, all from the signature of its function.

The options are the function's parameters and the fields of its `config`; a parameter that is a settings class is a
group, one that is positional alone has no flag. A value stands on the command line, else in the file that `--config`
names, else it is the default.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import itertools
import json
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import docstring_parser

from endopilot.cli.arguments import Answer, show
from endopilot.errors import InputError
from endopilot.files import regular
from endopilot.runs import Place, check_new, check_outside, existing
from endopilot.settings import Within, is_settings, read_settings, settings

LISTED_AT_MOST = 10
LISTED: Mapping[str, str] = MappingProxyType(
    {
        "run": "output target device method vessel seeds sequences seconds training_seconds json",
        "segment": "output method vessel seeds series phase reference picture json",
        "anatomy": "output vessel ostium_mm label name scale catheter_radius_mm picture ct json",
        "phantom": "output seed in_plane_mm slice_mm lumen_hu noise_hu calcium stents motion_mm json",
        "simulate": "output device catheter controls sequences seconds seed motion picture json",
        "dataset": "output device catheter sequences seconds seed control friction motion json",
        "train": "output network epochs batch_size max_seconds seed json",
        "plan": "target output device catheter model method seconds force_limit_n xray json",
        "navigate": "target output policy device catheter world robot xray seed json",
        "ladder": "output policy tasks patients version robot world table check json",
        "xray": "output show view_deg zoom device inserted_length_mm catheter catheter_inserted_length_mm ct json",
        "locate": "camera output picture page device landmark_mm landmark_px registration_sd_mm travel_mm json",
        "angiograms": "output device catheter cines seconds seed drive motion dose json",
        "calibrate": "anatomy output device robot given episodes wires seed json",
        "advise": "output also_test xray level wall_ratio abscissa_mm missed ostium_mm seed json",
        "cockpit": "device catheter robot task world replay resume output browser port",
    }
)
"""What `--help` lists of commands that have more than `LISTED_AT_MOST` flags: those that are set most often."""
_USUAL = {
    "anatomy": "folder made by `endopilot anatomy` or `endopilot atlas`.",
    "catheter": "up to two catheters around it, from the inside out: names (docs/concepts/devices.md) or YAML files.",
    "device": "name of a device (`endopilot devices`) or a YAML file.",
    "json": "print the figures as JSON.",
    "overwrite": "replace files that lie where this command writes.",
    "phase": "cardiac phase, such as 75 (per cent), where a DICOM series holds several.",
    "scheduler": "address of a Dask scheduler (tcp://host:8786) whose workers simulate and share these folders; the "
    "cores of this machine if not given.",
    "series": "number or instance UID of the series, where a DICOM folder holds several.",
    "target": "section label such as 4 or LAD, or point X,Y,Z in LPS mm (--target=-1.5,2,3 if it begins with a minus).",
    "topics": "of a ROS bag: command=TOPIC, encoder=, load=, tip=, episode=; joints by name as TOPIC:JOINT,JOINT.",
    "volume": "DICOM folder or file, NIfTI, NRRD or MHA, in HU.",
}
"""What options of several commands mean where a command says nothing else."""
Note = TypeVar("Note")
_WORDS = {bool: "", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
_NEGATIVE = re.compile(r"-\.?\d")


@dataclass(frozen=True)
class Option:
    """An option of a command, with what its field is called, takes, is set to and means; or a group of options."""

    name: str
    kind: Any
    value: Any
    meaning: str
    required: bool = False
    positional: bool = False
    group: tuple[Option, ...] = ()

    @property
    def flags(self) -> list[str]:
        """How it is called: `-o` and `--output`; in capitals if it is given by its place, without a flag."""
        if self.positional:
            return [f"[{self.name.upper()} ...]" if self.variadic else self.name.upper()]
        short = ["-o"] if self.name == "output" else []
        return [*short, f"--{'no-' if self.value is True else ''}{self.name.replace('_', '-')}"]

    @property
    def takes(self) -> str:
        """What follows the flag, such as `FLOAT FLOAT`; nothing after a switch."""
        return "" if self.positional else _takes(self.kind)

    @property
    def variadic(self) -> bool:
        """Whether it takes any number of values."""
        return _takes(self.kind).endswith("...]")

    @property
    def default(self) -> str:
        """Its value as the command line would have it; "required" if there is none, empty if it may be left out."""
        return "required" if self.required else "" if isinstance(self.value, bool) else _words(self.value)

    @property
    def range(self) -> str:
        """What numbers it takes, in words; empty if it takes any, or no number."""
        limits = next(iter(_notes(self.kind, Within)), Within())
        words = limits.mend(whole=False).removeprefix("give a ").removeprefix("number ")
        return "" if limits == Within() else words

    def leaves(self) -> Iterator[Option]:
        """Yield the options of a group, or the option itself."""
        yield from itertools.chain.from_iterable(one.leaves() for one in self.group) if self.group else (self,)


class Command:
    """A command, such as `endopilot plan`: a function whose parameters and settings are its options. `settings` is the
    class of all of them, which a file for `--config` holds, `defaults` what they are set to if nothing is given."""

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        """Read the signature of `function`; if it returns something, that is shown and the command has `--json`."""
        self.name, self._function = name, function
        self._text = docstring_parser.parse(function.__doc__ or "")
        self._parameters = dict(inspect.signature(function).parameters)
        hints = get_type_hints(function, include_extras=True)
        config = self._parameters.pop("config").default if "config" in self._parameters else None
        self._config = type(config)
        own = {
            one.name: (hints[one.name] | None, None) if one.default is one.empty else (hints[one.name], one.default)
            for one in self._parameters.values()
        }
        if any(place.of == "file" for kind, _ in own.values() for place in _notes(kind, Place)):
            own |= {"overwrite": (bool, False)}
        own |= {} if hints["return"] is NoneType else {"json": (bool, False)}
        self._own = tuple(own)
        content = {"__annotations__": {one: kind for one, (kind, _) in own.items()}}
        content |= {one: default for one, (_, default) in own.items()}
        self.settings = settings(type("Options", () if config is None else (self._config,), content))
        self.defaults = self.settings(**({} if config is None else _contents(config)))

    @property
    def summary(self) -> str:
        """What it does: a sentence, and paragraphs with more."""
        return "\n\n".join(part for part in (self._text.short_description, self._text.long_description) if part)

    def options(self, values: Any = None) -> list[Option]:
        """Return its options, set to `values` or the defaults: its function's in order, then its settings'."""
        meanings = _USUAL | _meanings(self._config)
        meanings |= {one.arg_name: _line(one.description) for one in self._text.params}
        tree = {one.name: one for one in _options(self.defaults if values is None else values, meanings)}
        for name, one in self._parameters.items():
            option, positional = tree[name], one.kind is one.POSITIONAL_ONLY
            if one.default is one.empty:
                option = replace(option, kind=get_args(option.kind)[0], required=option.value in (None, ()))
            tree[name] = replace(option, positional=positional)
        return [tree.pop(name) for name in self._own] + list(tree.values())

    def run(self, arguments: Sequence[str], *, shown: bool = True) -> Any:
        """Do what the arguments ask for, print what comes of it if that is to be `shown`, and return it; None where
        they ask for a text. InputError for bad arguments, or a bad file of `--config`."""
        if not {"-h", "--help", "--help-all"}.isdisjoint(arguments):
            print(self.help(everything="--help-all" in arguments), end="")
            return None
        values = self.read(arguments)
        if "--print-config" in arguments:
            print(self.file(values), end="")
            return None
        answer = self.call(values)
        if shown and answer is not None:
            full = answer if isinstance(answer, Answer) else Answer(answer)
            for part in [full.figures] if values.json or full.shown is None else full.shown:
                show(part, as_json=values.json)
        return answer

    def call(self, values: Any) -> Any:
        """Return what the function returns for values of its options, an instance of `settings`, once its inputs are
        there and nothing lies in the way of its outputs."""
        places: list[tuple[Place, Path]] = []
        for one in itertools.chain.from_iterable(option.leaves() for option in self.options(values)):
            for path in one.value if isinstance(one.value, tuple) else (one.value,):
                if isinstance(path, str | Path):
                    regular(path)
                    places += [(place, Path(path)) for place in _notes(one.kind, Place)]
        inputs = [existing(path) for place, path in places if place.of == "input"]
        for place, path in places:
            if place.of == "folder":
                check_outside(path, inputs)
            for file in place.files(path):
                check_new(file, inputs, overwrite=values.overwrite)
        given = {name: getattr(values, name) for name in self._parameters}
        positional = [given.pop(name) for name, one in self._parameters.items() if one.kind is one.POSITIONAL_ONLY]
        if self._config is not NoneType:
            given["config"] = self._config(**{one.name: getattr(values, one.name) for one in fields(self._config)})
        return self._function(*positional, **given)

    def read(self, arguments: Sequence[str]) -> Any:
        """Return what the arguments set the options to, an instance of `settings`; InputError as `run`."""
        given = self._given(arguments)
        file, incomplete = given.pop("--config", None), given.pop("--print-config", False)
        start = self.defaults if file is None else read_settings(Path(file), self.settings, onto=self.defaults)
        return self.values(given, onto=start, incomplete=incomplete)

    def values(self, given: Mapping[str, Any], *, onto: Any = None, incomplete: bool = False) -> Any:
        """Return the options set to what is given by their names, else to the values `onto`, or the defaults;
        InputError for a bad value, or, unless it may be `incomplete`, for a missing one."""
        onto = self.defaults if onto is None else onto
        for one in () if incomplete else self.options(onto):
            if one.required and given.get(one.name, ()) == ():
                called = ", ".join(f"{flag} {one.takes}".rstrip() for flag in one.flags)
                _Parser(self.name).error(f"Missing from {self.name}: {called}")
        return _with(onto, given)

    def _given(self, arguments: Sequence[str]) -> dict[str, Any]:
        """Return what the arguments set, by name: what means nothing is text, which the settings refuse."""
        parser = _Parser(self.name, add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
        parser.add_argument("--config", dest="--config")
        parser.add_argument("--print-config", dest="--print-config", action="store_true")
        leaves = {leaf.name: leaf for one in self.options() for leaf in one.leaves()}
        for one in leaves.values():
            if one.positional:
                parser.add_argument(one.name, nargs="*" if one.variadic else "?")
            elif one.kind is bool:
                parser.add_argument(f"--{one.name.replace('_', '-')}", action=argparse.BooleanOptionalAction)
            else:
                count = "*" if one.variadic else len(one.takes.split())
                parser.add_argument(*one.flags, dest=one.name, nargs=count)
        words = [f" {word}" if _NEGATIVE.match(word) else word for word in arguments]  # no flag to argparse
        given = vars(parser.parse_intermixed_args(words))
        return given | {name: _meant(leaves[name].kind, of) for name, of in given.items() if name in leaves}

    def help(self, *, everything: bool) -> str:
        """Return the text of `--help`, or of `--help-all` with `everything`."""
        options = self.options()
        leaves = {leaf.name: leaf for one in options for leaf in one.leaves()}
        places = [leaf for leaf in leaves.values() if leaf.positional]
        if everything:
            groups = {"options": [one for one in options if not one.group]}
            groups |= {one.meaning.rstrip("."): list(one.leaves()) for one in options if one.group}
        elif listed := LISTED.get(self.name.removeprefix("endopilot ")):
            groups = {"options": places + [leaves[name] for name in listed.split()]}
        else:
            groups = {"options": list(leaves.values())}
        hidden = len(leaves) - sum(map(len, groups.values()))
        more = f"`{self.name} --help-all` lists {hidden} more options. " if hidden else ""
        parser = argparse.ArgumentParser(
            usage=" ".join([self.name, *(one.flags[0] for one in places), "[OPTIONS]"]),
            description=_wrapped(self.summary),
            epilog=_wrapped(
                f"{more}--config FILE reads options from a YAML file; --print-config writes one to start from. "
                "Flags win over the file."
            ),
            add_help=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for title, group in groups.items():
            section = parser.add_argument_group(title)
            for one in group:
                note = "(required)" if one.required else f"(default: {one.default})" if one.default else ""
                kind: dict[str, Any] = (
                    {"metavar": one.takes} if one.takes else {} if one.positional else {"action": "store_true"}
                )
                section.add_argument(*one.flags, help=f"{one.meaning} {note}".replace("%", "%%"), **kind)
        return parser.format_help()

    def file(self, values: Any = None) -> str:
        """Return the text of a file for `--config` that holds `values`, an instance of `settings`, or the defaults."""
        head = f"# Options of `{self.name}` for --config. Flags on the command line win over them."
        return "\n".join([head, *_yaml(self.options(values), ""), ""])


class _Parser(argparse.ArgumentParser):
    """What splits a command line into options, and refuses as we do."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; `{self.prog} --help` lists the options")


def _options(values: Any, meanings: Mapping[str, str]) -> Iterator[Option]:
    kinds = get_type_hints(type(values), include_extras=True)
    for name, value in _contents(values).items():
        group = tuple(_options(value, _meanings(type(value)))) if is_settings(type(value)) else ()
        yield Option(name, kinds[name], value, meanings.get(name, ""), group=group)


@cache
def _meanings(cls: type) -> dict[str, str]:
    """Return what the fields of a settings class mean, each in one line: their docstrings."""
    found = (docstring_parser.parse_from_object(kind).params for kind in reversed(cls.__mro__) if is_settings(kind))
    return {one.arg_name: _line(one.description) for one in itertools.chain.from_iterable(found)}


def _contents(values: Any) -> dict[str, Any]:
    return {one.name: getattr(values, one.name) for one in fields(values)}


def _with(values: Any, given: Mapping[str, Any]) -> Any:
    new = {
        name: _with(old, given) if is_settings(type(old)) else given.get(name, old)
        for name, old in _contents(values).items()
    }
    return type(values)(**new)


def _meant(kind: Any, words: Any) -> Any:
    """Return what a word of a command line, or words, mean for a kind; what is no number stays text."""
    inner, origin = get_args(kind), get_origin(kind)
    if kind is bool:
        return words
    if origin in (Annotated, Union, UnionType):
        return None if words == ["None"] and NoneType in inner else _meant(inner[0], words)
    if origin is tuple:
        size = len(_takes(inner[0]).split())
        parts = [words[k : k + size] for k in range(0, len(words), size)]
        kinds = inner[:1] * len(parts) if ... in inner else inner
        return tuple(_meant(one, part) for one, part in zip(kinds, parts, strict=False))
    word = words if isinstance(words, str) else words[0]
    word = word[1:] if word.startswith(" ") and _NEGATIVE.match(word[1:]) else word
    if origin is Literal:
        return next((one for one in inner if str(one) == word), word)
    with contextlib.suppress(ValueError):
        return kind(word) if kind in (int, float) else word
    return word


def _notes(kind: Any, of: type[Note]) -> list[Note]:
    """Return the notes of a class in the annotations of a kind, and of those within it."""
    inner = get_args(kind)
    return [one for one in inner if isinstance(one, of)] + [note for one in inner for note in _notes(one, of)]


def _takes(kind: Any) -> str:
    """Return in capitals what a value of some kind is written as on the command line."""
    inner = get_args(kind)
    if get_origin(kind) is Annotated:
        written = [one for one in inner[1:] if isinstance(one, Place) and one.of != "input"]
        return {"folder": "DIR", "file": "FILE"}[written[0].of] if written else _takes(inner[0])
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, inner))}}}"
    if get_origin(kind) is tuple:
        return f"[{_takes(inner[0])} ...]" if inner[-1] is Ellipsis else " ".join(map(_takes, inner))
    return _WORDS[kind] if kind in _WORDS else "|".join(_takes(one) for one in inner if one is not NoneType)


def _words(value: Any) -> str:
    return " ".join(map(_words, value)) if isinstance(value, tuple) else "" if value is None else str(value)


def _yaml(options: Sequence[Option], indent: str) -> Iterator[str]:
    """Yield the lines of options in a YAML file, below what they mean."""
    note = f"{indent}# "
    for one in options:
        yield ""
        yield from textwrap.wrap(one.meaning, 120, initial_indent=note, subsequent_indent=note)
        if one.group:
            yield f"{indent}{one.name}:"
            yield from _yaml(one.group, f"{indent}  ")
        elif one.required:
            yield f"{note}{one.name}: {one.takes or _takes(one.kind)}  (required)"
        else:
            yield f"{indent}{one.name}: {json.dumps(one.value, default=str, ensure_ascii=False)}"


def _line(text: str | None) -> str:
    return " ".join((text or "").split())


def _wrapped(text: str) -> str:
    width = min(shutil.get_terminal_size().columns, 120) - 2
    return "\n\n".join(textwrap.fill(_line(part), width) for part in text.split("\n\n"))
