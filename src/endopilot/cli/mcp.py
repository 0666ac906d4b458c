"""`endopilot mcp`: ten tools for assistants, over the Model Context Protocol, with files inside one folder alone.

A tool is a command with some of its options. Their types, defaults and meanings are the command's.
"""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from typing_extensions import TypedDict

from endopilot import __version__
from endopilot.cli.arguments import Answer
from endopilot.cli.options import Option
from endopilot.devices.catheter import list_catheters
from endopilot.devices.device_files import list_wires
from endopilot.errors import InputError
from endopilot.imaging.segment import METHODS
from endopilot.navigation.policies import POLICIES
from endopilot.runs import Existing

_ABOUT = (
    "Vessels from CT angiograms, and guidewires simulated in them. Paths are relative to one folder. Units are mm, N, "
    "s, HU; coordinates LPS mm. segment and anatomy, or atlas, make a vessel; its sections are targets; plan, "
    "navigate; simulate, xray; replay and calibrate take a robot's logs. For research; no medical device."
)
_POINT, _FORCE = list[float], dict[str, Any](reached=bool, within_force_limit=bool, seconds=float, peak_force_n=float)
_SOME = dict.fromkeys(("tip_bend_deg", "inner_diameter_mm"), float | None)  # of wires or catheters alone
_FEW = {"lumen_ml": float, "ostium_lps_mm": _POINT | None, "warnings": list[str]}
TOOLS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "segment": ("volume output vessel method", {"mask": str} | _FEW),
    "anatomy": (
        "sources output vessel label",
        {"anatomy": str, "sections": list[str], "longest_path_mm": float, "ostium_lps_mm": _POINT, "notes": list[str]},
    ),
    "atlas": ("output vessel count seed", {"patient": str, "branches": int, "length_mm": float}),
    "devices": ("", {"name": str, "diameter_mm": float, "friction": float} | _SOME),
    "plan": ("anatomy target output device catheter", {"plan": str, "tip_error_mm": float} | _FORCE),
    "navigate": (
        "anatomy target output device catheter policy seed",
        {"outcome": str, "exposures": int, "page": str | None} | _FORCE,
    ),
    "simulate": (
        "anatomy output controls device catheter",
        {"rollout": str, "samples": int, "deepest_tip_mm": float | None, "largest_wall_force_n": float | None},
    ),
    "xray": (
        "anatomy output show inserted_length_mm",
        {"image": str, "tip_row_column": _POINT | None, "mm_per_pixel": float},
    ),
    "replay": (
        "log anatomy output device topics",
        {"episodes": int, "error_along_mm": float, "real_branch_share": float | None},
    ),
    "calibrate": (
        "logs anatomy output device topics",
        {"robot": str, "wire": str, "error_along_mm": float, "estimates": dict[str, dict[str, Any]]},
    ),
}
"""Options of the command that each tool is, and what the tool answers; those of `_ROWS` a list of such answers."""
_ROWS = ("anatomy", "atlas", "devices")


def mcp_command(folder: Existing, /) -> None:
    """Serve ten tools to an assistant on standard input and output, until it closes them. For research.

    Args:
        folder: whose files the tools may read and write; no others.
    """
    server(folder).run("stdio")


def server(folder: Path) -> Any:
    """Return the SDK's server with the tools, for `run` or for a client in this process; InputError for no folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the one whose files the tools may read and write")
    from mcp.server import MCPServer  # pyright: ignore[reportMissingImports]

    tools = [_tool(folder.resolve(), name) for name in TOOLS]
    return MCPServer("endopilot", version=__version__, instructions=_ABOUT, tools=tools)


def _tool(folder: Path, name: str) -> Any:
    """Return a tool: it refuses arguments that it does not have, and prints nothing into the protocol."""
    from mcp.server.mcpserver.exceptions import ToolError  # pyright: ignore[reportMissingImports]
    from mcp.server.mcpserver.tools import Tool  # pyright: ignore[reportMissingImports]

    from endopilot.cli import command_of

    made, (shown, answered) = command_of(name), TOOLS[name]
    options = {leaf.name: leaf for one in made.options() for leaf in one.leaves() if leaf.name in shown.split()}
    kind = TypedDict(f"{name.title()}Answer", answered)  # pyright: ignore[reportArgumentType, reportGeneralTypeIssues]

    def tool(**given: Any) -> Any:
        try:
            values = made.values({key: _inside(folder, options[key], value) for key, value in given.items()})
            with contextlib.redirect_stdout(sys.stderr):
                answer = made.call(values)
        except InputError as error:
            raise ToolError(str(error).replace(f"{folder}/", "")) from None
        figures = answer.figures if isinstance(answer, Answer) else answer
        answers = [_answer(folder, row, answered) for row in ([figures] if isinstance(figures, Mapping) else figures)]
        return answers if name in _ROWS else answers[0]

    parameters = [
        inspect.Parameter(
            each.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if each.required else each.value,
            annotation=Annotated[each.kind, Field(description=each.meaning)],
        )
        for each in options.values()
    ]
    returned = list[kind] if name in _ROWS else kind
    vars(tool)["__signature__"] = inspect.Signature(parameters, return_annotation=returned)
    tool.__name__, tool.__doc__ = name, made.summary
    served = Tool.from_function(tool)
    strict = {"model_config": ConfigDict(extra="forbid", coerce_numbers_to_str=True)}  # section 4 is "4"
    asked = type(f"{name}Arguments", (served.fn_metadata.arg_model,), strict)
    served.fn_metadata.arg_model, served.parameters = asked, asked.model_json_schema(by_alias=True)
    return served


def _inside(folder: Path, option: Option, value: Any) -> Any:
    """Return an option's value, paths in the folder; InputError for a path out of it, by `..`, as an absolute one or by
    a link, or for a name of code that is not the package's own."""
    if isinstance(value, list | tuple):
        return tuple(_inside(folder, option, each) for each in value)
    own = {"policy": POLICIES.shipped, "method": METHODS.shipped}.get(option.name)
    if own is not None and value not in own and value != option.value:
        raise InputError(f"{option.name}: {value!r}; choose from {', '.join(own)}")
    shipped = {"device": list_wires(), "catheter": list_catheters()}.get(option.name)
    if isinstance(value, Path) or (value is not None and shipped is not None and value not in shipped):
        place = (folder / value).resolve()
        if not place.is_relative_to(folder):
            raise InputError(f"{option.name}: {value} leads out of the folder of this server; give a path in it")
        return type(value)(place)
    return value


def _answer(folder: Path, figures: Mapping[str, Any], answered: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures that a tool answers, paths relative to the folder."""
    found = {key: figures.get(key) for key in answered}
    return {
        key: str(value).replace(f"{folder}/", "") if isinstance(value, str | Path) else value
        for key, value in found.items()
    }
