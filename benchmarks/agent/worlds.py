"""Drive the agent in worlds that it does not know: `python -m benchmarks worlds -o FOLDER`.

In every world the agent drives to a target (planned), and a wire is driven at random under the agent's belief, which
asks for X-ray (random). The targets are those of the seven coronary tasks of the ladder. The patients are new: two sets
of atlases that neither the ladder nor a training, a calibration or another benchmark has. On `development` an agent may
be improved; `test` is for what is published. Both are the first nine patients of each atlas that
`benchmarks.agent.ladder_patients.choose` takes, by the ladder's own rules; the atlas of a task has the seed 19000, or
20000, and the task's level. Beside the shipped worlds, or in their place, some are drawn at random (`drawn_worlds`).

Events are those of `count_navigation_events`: contacts, tips astray, in another branch too, and forces beyond the
limit. Decisions in both bands are those of `NavigationRecord.in_bands`; a decision that has no band, as of a wire that
is lost, counts as outside.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float

from benchmarks.agent.drawn_worlds import drawn_world
from benchmarks.figures import Bar, judged
from endopilot.belief.identification import Identified
from endopilot.belief.monitor import BelievedTip, Monitor
from endopilot.belief.watch import MISMATCH
from endopilot.control.agent import AgentPolicy
from endopilot.control.agent_config import AgentConfig, read_agent_calibration
from endopilot.files import read_json, write_json
from endopilot.ladder.attempt import navigation_events
from endopilot.ladder.terms import Terms
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Decision, Observation
from endopilot.navigation.record import NavigationRecord, count_navigation_events
from endopilot.runs import OutputFolder, claim, make_missing
from endopilot.settings import Seed, Within
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.world import NOMINAL, World, list_worlds, read_world
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import CORE, NEWEST, Patients, Task, find_task
from endopilot.types import SAMPLE_PERIOD_S

Set = Literal["development", "test"]
Drive = Literal["planned", "random"]
DRAWN = "drawn-{seed}-{number:03d}"
"""Name of a world that is drawn."""
PATIENTS: dict[Set, dict[str, tuple[int, tuple[int, ...]]]] = {
    "development": {
        "descending": (19002, (0, 1, 2, 3, 4, 5, 6, 7, 8)),
        "stenosis": (19003, (5, 14, 15, 23, 26, 27, 28, 35, 38)),
        "tortuous": (19004, (0, 8, 10, 11, 13, 15, 19, 20, 21)),
        "crux": (19006, (10, 14, 18, 36, 60, 62, 68, 74, 85)),
        "diagonal": (19007, (2, 17, 23, 24, 33, 38, 50, 54, 72)),
        "circumflex": (19008, (0, 1, 2, 5, 7, 9, 13, 14, 15)),
        "marginal": (19009, (2, 7, 15, 16, 23, 25, 26, 31, 34)),
    },
    "test": {
        "descending": (20002, (0, 1, 2, 3, 4, 5, 6, 7, 8)),
        "stenosis": (20003, (7, 10, 18, 23, 32, 33, 35, 37, 44)),
        "tortuous": (20004, (3, 4, 12, 17, 20, 21, 23, 33, 34)),
        "crux": (20006, (4, 6, 17, 26, 29, 33, 55, 58, 62)),
        "diagonal": (20007, (5, 8, 13, 14, 15, 18, 19, 23, 30)),
        "circumflex": (20008, (3, 4, 8, 9, 10, 13, 15, 17, 18)),
        "marginal": (20009, (0, 3, 8, 11, 12, 18, 19, 21, 26)),
    },
}
"""Of each set and task, the seed of the atlas and the numbers of the patients in it."""
PLACES = 63
"""Patients of a set."""
SHOWN = 5
"""Exposures after which the ostium is to be known."""
SECONDS = 60.0
"""Length of a navigation at random, s."""
MOST_EXPOSURES = 40
"""No planned navigation shall take more."""
SIDES = ("left", "back", "head")
"""Axes of LPS, as the parameters of a registration name them."""
DEVIATE = 1.96
"""Normal deviate of an interval of 95 %."""
BARS = {
    "missed_share": Bar(0.06),
    "exposures_per_minute_nominal": Bar(17),
    "exposures_per_minute_other": Bar(27),
    "in_bands_share": Bar(0.88, at_least=True),
    "in_bands_share_worst": Bar(0.75, at_least=True),
    "safe_share": Bar(0.95, at_least=True),
    "safe_share_worst": Bar(0.85, at_least=True),
    "exposures_planned": Bar(7),
    "exposures_planned_nominal": Bar(4),
    "navigations_above_40_exposures": Bar(0),
    "unsafe_by_force_share": Bar(0.01),
    "false_alarms_share": Bar(0.1),
    "intervals_held_share": Bar(0.75, at_least=True),
    "intervals_missed_share": Bar(0.15, at_least=True),
    "ostium_error_mm": Bar(0.25),
    "wall_right_share": Bar(0.85, at_least=True),
}


class DrivenAtRandom:
    """The agent's monitor, while random velocities drive the wire.

    Attributes:
        ostium_mm: where the ostium is believed to be after `SHOWN` exposures, mm deeper than given; None before.
    """

    ostium_mm: float | None = None

    def start(self, navigation: Navigation, seed: int) -> None:
        """Lay out the simulated wires, and draw the velocities."""
        calibration = read_agent_calibration(navigation.xray, len(navigation.devices))
        self._monitor = Monitor(navigation, calibration, config=AgentConfig.of(navigation).belief)
        config = ControlConfig(first_inserted_length_mm=navigation.start_inserted_length_mm, start_spread=0.0)
        _, control = random_controls(
            config,
            n_sequences=1,
            n_samples=round(SECONDS / SAMPLE_PERIOD_S),
            seed=seed,
            max_inserted_length_mm=float(navigation.anatomy.tree.longest_path().abscissa[-1]),
        )
        self._velocities, self._shown = [(v, w) for v, w in control[0, :, 0].tolist()], 0

    def decide(self, observation: Observation) -> Decision:
        """Move on at random, and ask for X-ray as the agent does."""
        self._believed = self._monitor.step(observation.devices, observation.load, observation.tip)
        self._shown += observation.tip is not None
        if self._shown == SHOWN and self.ostium_mm is None:
            self.ostium_mm = self._monitor.belief.mean_ostium_mm
        wanted = (self._velocities[round(observation.time_s / SAMPLE_PERIOD_S)],)
        self._monitor.belief.drives.sent(wanted)
        return Decision(wanted, expose=bool(self._believed.asks))

    @property
    def monitor(self) -> Monitor:
        """What follows the wire."""
        return self._monitor

    def believed(self) -> BelievedTip:
        """Return where the monitor has the tip."""
        return self._believed

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the simulated wires."""
        return self._monitor.belief.wires


def navigation_at(patients: Set, place: int) -> tuple[Task, Navigation, int]:
    """Return the task and the navigation at a place of a set, and its seed; neighbours have other tasks."""
    names = list(PATIENTS[patients])
    task = find_task(names[place % len(names)])
    atlas, numbers = PATIENTS[patients][task.name]
    number = numbers[place // len(names)]
    turn = np.random.default_rng([atlas, number]).uniform(0.0, 2 * np.pi)
    patient = task.patient(Patients(seed=atlas, numbers=(number,)), 0)
    return task, task.navigation(patient, start_rotation_rad=turn), 1000 * atlas + number


def measure(path: Path, worlds: Mapping[str, World], patients: Set) -> None:
    """Navigate in one patient of one world, and write what came of it."""
    task, navigation, seed = navigation_at(patients, int(path.stem))
    at_random = path.parent.name == "random"
    world, driver = worlds[path.parent.parent.name], DrivenAtRandom() if at_random else AgentPolicy()
    loop = NavigationLoop(
        replace(navigation, seconds=SECONDS) if at_random else navigation,
        driver,
        config=LoopConfig(simulator=replace(CORE, threads=1)),
        seed=seed,
        world=world,
    )
    result = counted(driven_on(loop) if at_random else loop.run(), navigation)
    found_mm = driver.ostium_mm if isinstance(driver, DrivenAtRandom) else None
    result |= identified(driver.monitor.identified, loop.world, found_mm)
    write_json(path, {"task": task.name, "patient": navigation.anatomy.name} | result)


def driven_on(loop: NavigationLoop) -> NavigationRecord:
    """Return the record of a navigation that goes on where it happens to reach its target."""
    while loop.time_s < SECONDS and loop.reason != "invalid":
        loop.step()
        if loop.reason == "reached":
            loop.go_on()
    return loop.record()


def counted(record: NavigationRecord, navigation: Navigation) -> dict[str, Any]:
    """Return what is counted of a navigation."""
    assert record.believed is not None
    radius_mm, kinds = navigation.device.tip_radius_mm, count_navigation_events(record, navigation)
    return {
        "reason": record.gives_up or record.reason,
        "success": record.success,
        "safe": record.safe,
        "seconds": record.seconds,
        "exposures": record.exposures,
        "peak_force_n": record.peak_force_n,
        "events": {kind: list(each) for kind, each in kinds.items()},
        "events_before": navigation_events(record.tip[:, 0], record.exposed, record.believed[:-1, 0], radius_mm),
        "decisions": [int(record.in_bands.sum()), len(record.exposed) - 1],
        "alarms": sum(MISMATCH in asks for asks in record.asks),
        "found": record.found,
    }


def identified(found: Identified | None, world: World, ostium_mm: float | None) -> dict[str, Any]:
    """Return how well a wrong ostium (error in mm) and the kind of wall were found, None where they were not, and which
    of the intervals that are stated hold.

    Args:
        ostium_mm: where the ostium is believed, mm deeper than given; None where that is not known.
    """
    compliant = "rigid" if world.compliant_wall_n_mm2 is None else "compliant"
    interval = {} if found is None else found.interval
    stated = {name: ends for name, ends in interval.items() if ends is not None}
    wall = "unknown" if found is None else found.wall
    return {
        "ostium_error_mm": None if ostium_mm is None or not world.ostium_mm else abs(ostium_mm - world.ostium_mm),
        "wall_right": None if wall == "unknown" else wall == compliant,
        "intervals": {name: low <= true_value(world, name) <= high for name, (low, high) in stated.items()},
    }


def true_value(world: World, name: str) -> float:
    """Return what a parameter of the hypotheses truly is in a world."""
    field, _, side = name.partition(" ")
    value = getattr(world, field)
    return value[SIDES.index(side)] if side else value


def row(world: str, drive: Drive, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the row of one world and drive."""
    (held, decisions), before = (
        np.sum([result[name] for result in results], axis=0).tolist() for name in ("decisions", "events_before")
    )
    contacts = np.sum([result["events"]["contact"] for result in results], axis=0).tolist()
    happened, missed, _ = np.sum([each for result in results for each in result["events"].values()], axis=0).tolist()
    intervals = [holds for result in results for holds in result["intervals"].values()]
    seconds, exposures = (sum(result[name] for result in results) for name in ("seconds", "exposures"))
    return {
        "world": world,
        "drive": drive,
        "navigations": len(results),
        "safe": sum(result["success"] and result["safe"] for result in results) if drive == "planned" else None,
        "unsafe_by_force": sum(not result["safe"] for result in results) if drive == "planned" else None,
        "events": happened,
        "missed": missed,
        "events_before": before[0],
        "missed_before": before[1],
        "contacts": contacts[0],
        "contacts_missed": contacts[1],
        "contacts_missed_evenly": contacts[2],
        "intervals": len(intervals),
        "intervals_held": sum(intervals),
        "decisions": decisions,
        "in_bands": held,
        "exposures": exposures,
        "most_exposures": max(result["exposures"] for result in results),
        "above_40": sum(result["exposures"] > MOST_EXPOSURES for result in results),
        "seconds": seconds,
        "alarmed": sum(result["alarms"] > 0 for result in results),
        "ostium_errors_mm": _known(results, "ostium_error_mm"),
        "walls": len(_known(results, "wall_right")),
        "walls_right": sum(_known(results, "wall_right")),
    }


def _known(results: Sequence[Mapping[str, Any]], name: str) -> list[Any]:
    return [result[name] for result in results if result.get(name) is not None]


def share(rows: Sequence[Mapping[str, Any]], part: str, whole: str) -> float | None:
    """Return a share over several rows; None where there is nothing to share."""
    total = sum(each[whole] for each in rows)
    return sum(each[part] for each in rows) / total if total else None


def sure(part: float, whole: int) -> tuple[float, float]:
    """Return the interval in which a share is with 95 %, as Wilson has it."""
    spread = DEVIATE * float(np.sqrt(part * (whole - part) / whole + DEVIATE**2 / 4))
    middle, size = part + DEVIATE**2 / 2, whole + DEVIATE**2
    return (middle - spread) / size, (middle + spread) / size


def figures(rows: Sequence[Mapping[str, Any]]) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Return the figures of the rows of all worlds, and those that are shares with the interval in which each is with
    95 %; those without navigations are left out.

    They are of the worlds other than the nominal one where their names do not say so. `in_bands_share` is that of
    planned or of random navigations, whichever is smaller; `worst` is the mean of the tenth of the worlds in which a
    figure is worst, `before` counts events as the ladder does, and `evenly` would as many exposures at even times.
    """
    nominal = [each for each in rows if each["world"] == NOMINAL]
    other = [each for each in rows if each["world"] != NOMINAL]

    def of(drive: Drive, some: Sequence[Mapping[str, Any]] = other) -> list[Mapping[str, Any]]:
        return [each for each in some if each["drive"] == drive]

    def worst(rows: Sequence[Mapping[str, Any]], part: str, whole: str, *, most: bool = False) -> float | None:
        worlds = sorted({each["world"] for each in rows})
        shares = [share([each for each in rows if each["world"] == world], part, whole) for world in worlds]
        found = sorted((value for value in shares if value is not None), reverse=most)
        return float(np.mean(found[: max(1, round(len(found) / 10))])) if found else None

    def a_minute(rows: Sequence[Mapping[str, Any]]) -> float | None:
        a_second = share(rows, "exposures", "seconds")
        return None if a_second is None else 60 * a_second

    ostia = [error for each in rows for error in each["ostium_errors_mm"]]
    shares: dict[str, tuple[Sequence[Mapping[str, Any]], str, str]] = {
        "missed_share": (of("random"), "missed", "events"),
        "missed_share_planned": (of("planned"), "missed", "events"),
        "in_bands_share_random": (of("random"), "in_bands", "decisions"),
        "in_bands_share_planned": (of("planned"), "in_bands", "decisions"),
        "safe_share": (of("planned"), "safe", "navigations"),
        "unsafe_by_force_share": (of("planned"), "unsafe_by_force", "navigations"),
        "false_alarms_share": (nominal, "alarmed", "navigations"),
        "alarms_share": (other, "alarmed", "navigations"),
        "missed_share_before": (of("random"), "missed_before", "events_before"),
        "missed_share_planned_before": (of("planned"), "missed_before", "events_before"),
        "contacts_missed_share": (other, "contacts_missed", "contacts"),
        "contacts_missed_share_evenly": (other, "contacts_missed_evenly", "contacts"),
        "intervals_held_share": (rows, "intervals_held", "intervals"),
        "wall_right_share": (of("random", rows), "walls_right", "walls"),
    }
    known = {name: found for name, each in shares.items() if (found := share(*each)) is not None}
    bands = [value for name, value in known.items() if name.startswith("in_bands_share_")]
    found = {
        **known,
        "missed_share_worst": worst(of("random"), "missed", "events", most=True),
        "exposures_per_minute_nominal": a_minute(of("random", nominal)),
        "exposures_per_minute_other": a_minute(of("random")),
        "in_bands_share": min(bands, default=None),
        "in_bands_share_worst": worst(other, "in_bands", "decisions"),
        "safe_share_worst": worst(of("planned"), "safe", "navigations"),
        "exposures_planned": share(of("planned"), "exposures", "navigations"),
        "exposures_planned_nominal": share(of("planned", nominal), "exposures", "navigations"),
        "navigations_above_40_exposures": sum(each["above_40"] for each in rows if each["drive"] == "planned"),
        "events": sum(each["events"] for each in rows),
        "intervals_missed_share": 1 - known["intervals_held_share"] if "intervals_held_share" in known else None,
        "intervals": sum(each["intervals"] for each in rows),
        "ostium_error_mm": float(np.median(ostia)) if ostia else None,
    }
    within = []
    for name, value in known.items():
        whole = int(sum(each[shares[name][2]] for each in shares[name][0]))
        low, high = sure(value * whole, whole)
        within.append({"share": name, "is": round(value, 4), "from": round(low, 4), "to": round(high, 4), "of": whole})
    return {name: round(value, 4) for name, value in found.items() if value is not None}, within


def drive_in_worlds(
    *,
    output: OutputFolder,
    planned: Annotated[int, Within(0, PLACES)] = 11,
    random: Annotated[int, Within(0, PLACES)] = 6,
    worlds: tuple[str, ...] = (),
    drawn: Annotated[int, Within(0, 1000)] = 0,
    seed: Seed = 0,
    patients: Set = "test",
) -> dict[str, Any]:
    """Drive the agent, and a wire at random under its belief, in worlds that it does not know.

    `output`/WORLD/DRIVE gets one file a navigation; an interrupted run goes on with the others. The worlds take
    turns; each begins at a patient of its own, and goes on with the next of the set.

    Args:
        output: folder of the results.
        planned: navigations of the agent in each world.
        random: navigations at random in each world.
        worlds: names of worlds, or YAML files; if not given and none is drawn, the nominal one and all shipped ones of
            the rod core.
        drawn: worlds that are drawn at random.
        seed: of these.
        patients: set of the patients.

    Returns:
        The figures with their bars, shares with the intervals in which they are with 95 %, and a row for each world and
        drive.

    Raises:
        InputError: no such world, or the folder belongs to another run.
    """
    shipped = [name for name in list_worlds() if read_world(name).engine == "rod"]
    chosen = {Path(name).stem: read_world(name) for name in worlds or (() if drawn else shipped)}
    chosen |= {DRAWN.format(seed=seed, number=number): drawn_world(seed, number) for number in range(drawn)}
    paths: dict[tuple[str, Drive], list[Path]] = {}
    for name, world in chosen.items():
        identity = Terms(NEWEST, world=world).identity("agent")
        claim(output / name, "python -m benchmarks worlds", **identity, patients=patients)
        first = zlib.crc32(name.encode())
        counts: dict[Drive, int] = {"planned": planned, "random": random}
        for drive, count in counts.items():
            places = [(first + place) % PLACES for place in range(count)]
            paths[name, drive] = [output / name / drive / f"{place:02d}.json" for place in places]
    make = partial(measure, worlds=chosen, patients=patients)
    in_turns = [some[turn] for turn in range(PLACES) for some in paths.values() if turn < len(some)]
    make_missing("The agent in other worlds", in_turns, make)
    rows = [row(*key, [read_json(path) for path in some]) for key, some in paths.items() if some]
    found, within = figures(rows)
    bars = {name: bar for name, bar in BARS.items() if name in found}
    return judged(found, bars) | {"shares": within, "worlds": rows}
