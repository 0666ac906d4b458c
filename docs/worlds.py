"""Write the tables of docs/concepts/worlds.md, and docs/evidence/worlds.md: `python docs/worlds.py [FILE]`.

Those of fields and of shipped worlds are made of the package. Where the agent was driven in them, FILE holds what
`python -m benchmarks worlds -o FOLDER --json > FILE` printed.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import docstring_parser

sys.path.append(str(Path(__file__).parents[1]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.files import read_json
from endopilot.simulation.world import NOMINAL, Stenosis, World, list_worlds, read_world

PAGE = Path(__file__).parent / "concepts" / "worlds.md"
FIGURES = {
    "missed_share": "events missed, random drive",
    "missed_share_worst": "the same in the worst worlds, a tenth of them",
    "exposures_per_minute_nominal": "exposures a minute, random drive, nominal world",
    "exposures_per_minute_other": "exposures a minute, random drive, other worlds",
    "in_bands_share_random": "decisions in both bands, random drive",
    "in_bands_share_planned": "decisions in both bands, planned",
    "in_bands_share": "the smaller of both",
    "in_bands_share_worst": "the same in the worst worlds, a tenth of them",
    "safe_share": "planned navigations that arrived safely",
    "safe_share_worst": "the same in the worst worlds, a tenth of them",
    "exposures_planned": "exposures of a planned navigation",
    "exposures_planned_nominal": "the same in the nominal world",
    "navigations_above_40_exposures": "planned navigations with more than 40 exposures",
    "unsafe_by_force_share": "planned navigations beyond the force limit",
    "missed_share_planned": "events missed, planned",
    "missed_share_before": "events missed, random drive, counted as the ladder does",
    "missed_share_planned_before": "the same, planned",
    "contacts_missed_share": "contacts with the wall missed",
    "contacts_missed_share_evenly": "the same with as many exposures at even times",
    "intervals_held_share": "stated intervals of 80 % that hold",
    "intervals_missed_share": "and that do not",
    "false_alarms_share": "navigations in the nominal world with a false alarm",
    "alarms_share": "navigations in other worlds with an alarm",
    "ostium_error_mm": "error of an ostium that is off, after 5 exposures, median, mm",
    "wall_right_share": "kinds of wall found right, of those that are stated",
}
"""Figures of the agent in other worlds, in words."""
LEAST = (
    "in_bands_share",
    "in_bands_share_worst",
    "safe_share",
    "safe_share_worst",
    "wall_right_share",
    "intervals_held_share",
    "intervals_missed_share",
)
"""Figures that are to be at least as large as their bar."""


def page() -> str:
    """Return the page as it is to be: what stands between the markers is made of the record and its files."""
    text = PAGE.read_text(encoding="utf-8")
    shipped = [f"| `{name}` | {read_world(name).about} |" for name in list_worlds() if name != NOMINAL]
    tables = {
        "fields": _fields(World()),
        "stenosis": _fields(Stenosis()),
        "shipped": ["| world | what it is |", "| --- | --- |", *shipped],
    }
    for name, rows in tables.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        head, rest = text.split(begin)
        text = f"{head}{begin}\n" + "\n".join(rows) + f"\n{end}{rest.split(end)[1]}"
    return text


def _fields(defaults: World | Stenosis) -> list[str]:
    """Return a table of the fields of settings: name, default and docstring."""
    meanings = {
        one.arg_name: one.description or "" for one in docstring_parser.parse_from_object(type(defaults)).params
    }
    rows = ["| field | as given | in reality |", "| --- | --- | --- |"]
    for each in fields(defaults):
        value, meaning = getattr(defaults, each.name), " ".join(meanings[each.name].split())
        shown = "" if value in (None, "", ()) else f"`{list(value) if isinstance(value, tuple) else value}`"
        rows.append(f"| `{each.name}` | {shown} | {meaning} |")
    return rows


def _measured(found: Mapping[str, Any]) -> list[str]:
    """Return the figures of the agent in other worlds beside their bars, then the counts of each world."""
    rows = [f"| {len(found['worlds'])} rows below, {found['events']} events | measured | bar |", "| --- | --- | --- |"]
    for name, words in FIGURES.items():
        if name in found:
            bar = found["bars"].get(name)
            limit = "" if bar is None else f"{'≥' if name in LEAST else '≤'} {_shown(name, bar)}"
            rows.append(f"| {words} | {_shown(name, found[name])} | {limit} |")
    rows += [
        "",
        "| world | planned: arrived safely | beyond the force limit | exposures, mean (most) | events missed "
        "| in both bands | alarms | at random: events missed | exposures a minute | in both bands | alarms |",
        "| --- |" + " --- |" * 10,
    ]
    by_world: dict[str, dict[str, Mapping[str, Any]]] = {}
    for each in found["worlds"]:
        by_world.setdefault(each["world"], {})[each["drive"]] = each
    for world, drives in by_world.items():
        rows.append(f"| `{world}` | {_planned(drives.get('planned'))} | {_at_random(drives.get('random'))} |")
    return rows


def _planned(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return " | | | | | "
    count = row["navigations"]
    exposures = f"{row['exposures'] / count:.1f} ({row['most_exposures']})"
    force = f"{row['unsafe_by_force']} of {count}"
    return " | ".join([f"{row['safe']} of {count}", force, exposures, *_counts(row), f"{row['alarmed']} of {count}"])


def _at_random(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return " | | | "
    missed, held = _counts(row)
    a_minute = f"{60 * row['exposures'] / row['seconds']:.1f}"
    return " | ".join([missed, a_minute, held, f"{row['alarmed']} of {row['navigations']}"])


def _counts(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return how many events were missed, and the share of the decisions in both bands."""
    return f"{row['missed']} of {row['events']}", f"{100 * row['in_bands'] / row['decisions']:.0f} %"


def _shown(name: str, value: float) -> str:
    if "share" in name:
        return f"{100 * value:.1f} %"
    digits = 2 if name.endswith("_mm") else 1 if value % 1 else 0
    return f"{value:.{digits}f}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    if len(sys.argv) > 1:
        fill("evidence/worlds.md", "measured", _measured(read_json(Path(sys.argv[1]))))
