"""`endopilot mcp`: ten tools for assistants, over the Model Context Protocol, with files inside one folder alone."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_atlas
from endopilot.cli.anatomy import describe
from endopilot.cli.arguments import Answer, Existing
from endopilot.devices.device_files import list_wires
from endopilot.errors import InputError
from endopilot.imaging.segment import METHODS
from endopilot.navigation.policies import POLICIES

_ABOUT = (
    "Vessels from CT angiograms, and guidewires simulated in them. Paths are relative to one folder. Units are mm, N, "
    "s, HU; coordinates LPS mm. segment_ct, then extract_vessel (or draw_patient alone); describe_vessel names the "
    "sections that can be targets; plan, navigate; simulate, take_xray. For research; no medical device."
)


@dataclass(frozen=True)
class Mask:
    """A lumen mask: its file, volume in ml, ostium in LPS mm, and what seems odd."""

    mask: str
    lumen_ml: float
    ostium_lps_mm: list[float] | None
    warnings: list[str]


@dataclass(frozen=True)
class Vessel:
    """An anatomy: its folder, sections, lengths and radii in mm, and where it begins, LPS mm."""

    anatomy: str
    sections: list[str]
    branches: int
    longest_path_mm: float
    ostium_radius_mm: float
    smallest_radius_mm: float
    ostium_lps_mm: list[float]


@dataclass(frozen=True)
class Planned:
    """A plan: its folder, whether the tip arrives, s, N, and the tip's distance from the target at its end, mm."""

    plan: str
    reached: bool
    within_force_limit: bool
    seconds: float
    tip_error_mm: float
    peak_force_n: float


@dataclass(frozen=True)
class Driven:
    """A navigation: what happened in one line, s, X-ray exposures, N, and its page, if it was written."""

    outcome: str
    reached: bool
    within_force_limit: bool
    seconds: float
    exposures: int
    peak_force_n: float
    page: str | None


@dataclass(frozen=True)
class Rollout:
    """A simulated motion: its file, depth of the tip, mm, and largest force on a wall, N."""

    rollout: str
    samples: int
    deepest_tip_mm: float | None
    largest_wall_force_n: float | None


@dataclass(frozen=True)
class Xray:
    """An X-ray image: its file, the tip's row and column, and mm of a pixel."""

    image: str
    tip_row_column: list[float] | None
    mm_per_pixel: float


@dataclass(frozen=True)
class Replayed:
    """A log driven again: episodes, error along the vessel, mm, and share of forks taken as the real wire took them."""

    episodes: int
    error_along_mm: float
    real_branch_share: float | None


def command(folder: Positional[Existing], /) -> None:
    """Serve ten tools to an assistant on standard input and output, until it closes them. For research.

    Args:
        folder: whose files the tools may read and write; no others.
    """
    server(folder).run("stdio")


def server(folder: Path) -> Any:
    """Return the SDK's server with the tools, for `run` or for a client in this process."""
    from mcp.server import MCPServer  # pyright: ignore[reportMissingImports]

    made = MCPServer("endopilot", version=__version__, instructions=_ABOUT)
    for tool in (
        list_devices,
        draw_patient,
        segment_ct,
        extract_vessel,
        describe_vessel,
        plan,
        navigate,
        simulate,
        take_xray,
        replay_log,
    ):
        made.add_tool(_within(folder.resolve(), tool))
    return made


_PATHS = {"output", "ct", "source", "patient", "controls", "log"}
"""Parameters that are paths inside the folder; `device` is one where it is no device's name."""


def _within(folder: Path, tool: Callable[..., Any]) -> Callable[..., Any]:
    """Let a tool find its files in a folder alone, answer bad input in one line, and print nothing into the protocol.

    A path that leads out, by `..`, as an absolute one or by a link, is refused.
    """
    from mcp.server.mcpserver.exceptions import ToolError  # pyright: ignore[reportMissingImports]

    @functools.wraps(tool)
    def run(**given: Any) -> Any:
        try:
            for name, value in given.items():
                if value is not None and (name in _PATHS or (name == "device" and value not in list_wires())):
                    given[name] = str((folder / value).resolve())
                    if not Path(given[name]).is_relative_to(folder):
                        raise InputError(f"{name}: {value} leads out of the folder of this server; give a path in it")
            with contextlib.redirect_stdout(sys.stderr):
                found = tool(**given)
        except InputError as error:
            raise ToolError(str(error).replace(f"{folder}/", "")) from None
        return _shown(found, folder)

    vars(run)["__signature__"] = inspect.signature(tool, eval_str=True)
    return run


def _shown(found: Any, folder: Path) -> Any:
    """Return what a tool answers, with paths relative to the folder."""
    if isinstance(found, list):
        return found
    values = {field.name: getattr(found, field.name) for field in fields(found)}
    return type(found)(
        **{name: value.replace(f"{folder}/", "") if isinstance(value, str) else value for name, value in values.items()}
    )


def _answer(name: str, place: str, kind: type, **options: Any) -> Any:
    """Return what a command answers, as one of the records above."""
    from endopilot.cli import command_of

    given = [f"--{option.replace('_', '-')}={value}" for option, value in options.items() if value is not None]
    answer = command_of(name).answer([place, *given])
    figures = answer.figures if isinstance(answer, Answer) else answer
    values = {field.name: figures[field.name] for field in fields(kind)}
    return kind(**{key: str(value) if isinstance(value, Path) else value for key, value in values.items()})


def list_devices() -> list[dict[str, float | str | None]]:
    """List the guidewires: diameter (mm), bending and torsional stiffness (N·mm²), tip load (N), bend (°)."""
    from endopilot.cli import command_of

    return [dict(row) for row in command_of("devices").answer([]).figures]


def draw_patient(output: str, vessel: Literal["rca", "lca", "arch", "cerebral"] = "rca", seed: int = 0) -> Vessel:
    """Draw a synthetic patient's vessel from published statistics, and write its anatomy into a new folder."""
    if Path(output).exists():
        raise InputError(f"{output}: is there already; choose another folder")
    write_anatomy(next(make_atlas(config=AtlasConfig(vessel=vessel, seed=seed, count=1))), output=Path(output))
    return describe_vessel(output)


def segment_ct(ct: str, output: str, vessel: str | None = None, method: str | None = None) -> Mask:
    """Segment a vessel's lumen in a CT angiogram (DICOM folder, NIfTI, NRRD, MHA) into a mask (.nii.gz)."""
    _shipped("method", method, METHODS.shipped)
    return _answer("segment", ct, Mask, output=output, vessel=vessel, method=method)


def extract_vessel(source: str, output: str, vessel: str | None = None, label: str | None = None) -> Vessel:
    """Make an anatomy of a mask, a surface (STL, OBJ, PLY, VTP) or centerlines with radii."""
    return _answer("anatomy", source, Vessel, output=output, vessel=vessel, label=label)


def describe_vessel(patient: str) -> Vessel:
    """Tell an anatomy's sections, which can be targets, its lengths and radii."""
    found = {"anatomy": patient} | describe(read_anatomy(patient))
    return Vessel(**{field.name: found[field.name] for field in fields(Vessel)})  # pyright: ignore[reportArgumentType]


def plan(patient: str, target: str, output: str, device: str = "workhorse-014") -> Planned:
    """Plan controls that bring a wire's tip to a target: a section such as 4 or LAD, or a point X,Y,Z in LPS mm."""
    return _answer("plan", patient, Planned, target=target, output=output, device=device)


def navigate(
    patient: str, target: str, output: str, device: str = "workhorse-014", policy: str = "agent", seed: int = 0
) -> Driven:
    """Let a policy drive a wire to a target in closed loop, with X-ray only when it asks; writes a replay page."""
    _shipped("policy", policy, POLICIES.shipped)
    return _answer("navigate", patient, Driven, target=target, output=output, device=device, policy=policy, seed=seed)


def simulate(patient: str, output: str, controls: str | None = None, device: str | None = None) -> Rollout:
    """Drive a wire by controls (a plan's folder, .npz or .csv), or at random, and write its motion (.csv)."""
    return _answer("simulate", patient, Rollout, output=output, controls=controls, device=device)


def take_xray(
    patient: str,
    output: str,
    inserted_length_mm: float = 60.0,
    show: Literal["fluoroscopy", "contrast", "dsa", "roadmap"] = "fluoroscopy",
) -> Xray:
    """Push a wire in, and take an X-ray image (.png)."""
    return _answer("xray", patient, Xray, output=output, inserted_length_mm=inserted_length_mm, show=show)


def replay_log(log: str, patient: str, output: str, device: str = "workhorse-014") -> Replayed:
    """Simulate the commands of a robot's log (CSV or ROS bag), and compare the tips."""
    return _answer("replay", log, Replayed, anatomy=patient, output=output, device=device)


def _shipped(what: str, name: str | None, known: Any) -> None:
    """Refuse a name that is not the package's own: another would run any code."""
    if name is not None and name not in known:
        raise InputError(f"{what}: {name!r}; choose from {', '.join(known)}")
