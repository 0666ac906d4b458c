"""A navigation in one patient, in a folder: page, picture, table, trajectory, episode, manifest; `write_navigation`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from endopilot.anatomy.io import write_anatomy
from endopilot.anatomy.projection import safety_ratio
from endopilot.control.navigate import NavigateConfig, PatientNavigation, SetUp, drive, set_up_navigation
from endopilot.control.outcome import decision_times, name_target, slipped_s, tell_outcome, worst_ratio
from endopilot.control.set_up import tip_name
from endopilot.devices.stack import Stack
from endopilot.extras import extras_present
from endopilot.files import manifest, read_json, write_json, write_whole
from endopilot.runs import Existing, OutputFolder, claim
from endopilot.simulation.signals import table_columns
from endopilot.simulation.trajectory import TRAJECTORY
from endopilot.tasks.targets import section_at
from endopilot.types import TipProjection

PAGE_FILE, PICTURE_FILE, TABLE_FILE = "navigation.html", "navigation.png", "navigation.csv"
EPISODE_FOLDER, ANATOMY_FOLDER, MANIFEST_FILE = "episode", "anatomy", "manifest.json"


def navigate_into(
    anatomy: Existing,
    /,
    *,
    target: str,
    output: OutputFolder,
    policy: str = "agent",
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    config: NavigateConfig = NavigateConfig(),
) -> dict[str, Any]:
    """Let a policy drive a wire to a place of a patient's vessel: simulated robot, X-ray only when the policy asks.

    The folder gets navigation.html (replay and course), navigation.csv, navigation.png, trajectory.npz for `endopilot
    simulate`, episode for `endopilot train`, and manifest.json. Whether the target was reached, or why not,
    is the first line that is printed; the exit code is 0 either way.

    Args:
        output: folder of the results.
        policy: what decides: agent, cloned, oracle (which is given the truth), open-loop, forward, spin,
            retract-rotate, with a catheter in-turn or catheter-alone, or MODULE:OBJECT of your own.

    Raises:
        InputError: The navigation cannot begin, or the folder is another run's.
    """
    stack = Stack.of(device, *catheter)
    set_up = set_up_navigation(anatomy, target, policy=policy, device=stack, config=config)
    _claim(output, set_up)
    if (output / MANIFEST_FILE).exists():
        return read_json(output / MANIFEST_FILE)["figures"]
    return _write(drive(set_up), output, {"policy": policy, "device": device, "catheter": tuple(catheter)})


def write_navigation(driven: PatientNavigation, *, output: str | Path) -> dict[str, Any]:
    """Write a navigation in a patient into a folder: page, picture, table, trajectory, episode and manifest, and an
    anatomy in memory (docs: Navigate in a patient). Returns the outcome in one line, and figures; InputError if the
    folder belongs to another run."""
    _claim(Path(output), driven.set_up)
    return _write(driven, Path(output), None)


def _claim(output: Path, set_up: SetUp) -> None:
    claim(
        output,
        "endopilot navigate",
        anatomy=set_up.anatomy.identity,
        target=set_up.target,
        config=set_up.config,
        device=set_up.navigation.device,
        catheters=set_up.navigation.catheters,
        robot=set_up.robot,
        world=set_up.world.differences(),
        policy=set_up.policy_name,
        policy_origin=set_up.policy_origin,
    )


def _write(found: PatientNavigation, output: Path, asked: Mapping[str, Any] | None) -> dict[str, Any]:
    """Write what installed libraries make, the manifest last; return the figures. `asked`: the names typed."""
    set_up, present = found.set_up, extras_present()
    driven_in, real = set_up.folder, set_up.true_anatomy
    if driven_in is None or real is not set_up.anatomy:  # the catheter lies otherwise: an anatomy of its own
        driven_in = output / ANATOMY_FOLDER
        if not driven_in.exists():
            write_anatomy(real, output=driven_in)
    write_whole(output / TABLE_FILE, navigation_table(found).to_csv(index=False))
    cycles = found.record.cycles
    assert cycles is not None  # a navigation has a period at least
    about = {"policy": set_up.policy_name, "seed": set_up.config.seed, "world": _world(set_up)}
    about["robot"] = asdict(set_up.world.real_robot(set_up.robot))
    replace(cycles, about=cycles.about | about).write(output / TRAJECTORY)
    record = _manifest(found, page=str(output / PAGE_FILE) if present["report"] else None)
    if missing := [extra for extra in ("learn", "report") if not present[extra]]:
        record["figures"]["left_out"] = f"files that need: pip install 'endopilot[{','.join(missing)}]'"
    if present["learn"]:
        _write_episode(found, driven_in, output / EPISODE_FOLDER)
    if present["report"]:
        from endopilot.plotting import png  # matplotlib and plotly are slow to import
        from endopilot.report.navigation_page import navigation_figure, write_navigation_page

        picture, commands = png(navigation_figure(found)), _commands(found, driven_in, output, asked)
        write_whole(output / PICTURE_FILE, picture)
        write_navigation_page(output / PAGE_FILE, found, picture=picture, commands=commands, manifest=record)
    write_json(output / MANIFEST_FILE, record)
    return read_json(output / MANIFEST_FILE)["figures"]


def navigation_table(found: PatientNavigation) -> pd.DataFrame:
    """Return a row for the start and for the end of each decision period; docs/concepts/trajectory.md has them."""
    record, navigation = found.record, found.set_up.navigation
    tip, count = record.tip[:, 0], len(record.time_s)
    tree = navigation.anatomy.tree
    places = zip(tip.branch.tolist(), tip.abscissa.tolist(), strict=True)
    measured = [(np.nan, np.nan) if seen is None else (seen.abscissa, seen.offset) for seen in record.measured]
    nothing = np.full((count, 2), np.nan)
    signals = {
        **{name: getattr(record, name) for name in ("control", "inserted_length", "rotation", "tip_position")},
        **{name: getattr(record, name) for name in ("encoders", "load")},
        **{f"tip_{name}": getattr(record.tip, name) for name in TipProjection.__dataclass_fields__},
        "measured": np.array(measured),
        "believed": nothing if record.believed is None else record.believed,
        "half_width": nothing if record.half_width is None else record.half_width,
    }
    columns: dict[str, Any] = {
        "time_s": record.time_s,
        **table_columns(signals),
        "section": [section_at(tree, branch, at) for branch, at in places],
        "safety_ratio": safety_ratio(tip.offset, tip.radius, navigation.device.tip_radius_mm),
        "contact_force_n": record.contact_force_max,
        "xray": record.exposed.astype(int),
        "asks_for_xray": list(record.asks),
    }
    return pd.DataFrame(columns)


def _write_episode(found: PatientNavigation, anatomy_folder: Path, output: Path) -> None:
    from endopilot.dataset.generate import write_episode  # an extra brings its libraries

    set_up = found.set_up
    world, given = set_up.world, set_up.navigation.stack
    shaped = replace(world, tip_stiffness_factor=1.0, friction_factor=1.0)  # which the episode holds beside the wire
    write_episode(
        found.episode,
        anatomy_folder,
        output,
        replace(given, wire=shaped.wire(given.wire)),
        task=f"navigate to {name_target(set_up)}",
        tip_stiffness_factor=world.tip_stiffness_factor,
        seed=set_up.config.seed,
        origin={
            "target": asdict(set_up.navigation.target),
            "policy": set_up.policy_name,
            "navigation": asdict(set_up.config),
            "world": _world(set_up),
            "robot": asdict(world.real_robot(set_up.robot)),
        },
    )


def _manifest(found: PatientNavigation, *, page: str | None) -> dict[str, Any]:
    set_up, record = found.set_up, found.record
    navigation = set_up.navigation
    figures = {
        "outcome": tell_outcome(found),
        "reached": record.success,
        "within_force_limit": record.safe,
        "reason": record.reason,
        "policy": set_up.policy_name,
        "target": name_target(set_up),
        "snapped_mm": None if set_up.snapped_mm is None else round(set_up.snapped_mm, 2),
        "tip": tip_name(navigation.device),
        "why": set_up.choice.why,
        "catheter_tilt_deg": set_up.choice.tilt_deg,
        "seconds": record.seconds,
        "exposures": record.exposures,
        "peak_force_n": round(record.peak_force_n, 4),
        "largest_safety_ratio": round(worst_ratio(found), 3),
        "deepest_tip_mm": round(float(record.tip.abscissa[:, 0].max()), 2),
        "end_tip_mm": round(float(record.tip.abscissa[-1, 0]), 2),
        "target_mm": round(navigation.target.abscissa, 2),
        "drive_slipped_s": round(slipped_s(found), 2),
        "courses_searched": found.plans,
        "planning_processor_s": None if found.planning_s is None else round(found.planning_s, 2),
        "decision_s": decision_times(found),
        "page": page,
    }
    return manifest(
        config=set_up.config,
        seed=set_up.config.seed,
        inputs={},
        anatomy={"name": set_up.anatomy.name, "identity": set_up.anatomy.identity},
        device=asdict(navigation.device),
        catheters=[asdict(catheter) for catheter in navigation.catheters],
        catheter_axis=None if navigation.anatomy is set_up.anatomy else navigation.anatomy.insertion.direction.tolist(),
        target={"asked": set_up.target, **asdict(navigation.target)},
        world=_world(set_up),
        robot=asdict(set_up.world.real_robot(set_up.robot)),
        simulator=asdict(set_up.world.core(set_up.simulator)),
        figures=figures,
    )


def _world(set_up: SetUp) -> dict[str, Any]:
    return {"name": set_up.config.world, **set_up.world.differences()}


def _commands(
    found: PatientNavigation, driven_in: Path, output: Path, asked: Mapping[str, Any] | None
) -> Mapping[str, str]:
    again = ["endopilot", "simulate", str(driven_in), "--controls", str(output / TRAJECTORY), "-o", "again.csv"]
    alone = not found.set_up.navigation.catheters
    beside = ["endopilot", "train", "runs/dataset", str(output / EPISODE_FOLDER), "-o", "runs/training"]
    return {
        **({} if asked is None else {"The navigation": shlex.join(_line(found.set_up, output, asked))}),
        f"The same {'wire' if alone else 'motion'} from the recorded controls, without the policy": shlex.join(again),
        **({"Train on it beside a dataset of the same wire": shlex.join(beside)} if alone else {}),
    }


def _line(set_up: SetUp, output: Path, asked: Mapping[str, Any]) -> list[str]:
    """Return the command that made a navigation, with the options that are not at their defaults."""
    default = {"policy": "agent", "device": "workhorse-014", "catheter": (), **asdict(NavigateConfig())}
    options = [(name, value) for name, value in {**asked, **asdict(set_up.config)}.items() if value != default[name]]
    changed = [
        part
        for name, value in options
        for part in (f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,)))
    ]
    return ["endopilot", "navigate", str(set_up.folder), f"--target={set_up.target}", "-o", str(output), *changed]
