"""A session on disk: one line an event, written as it happens, so that nothing is lost when the server is killed.

The first line says what the session was held in. Each further one is a JSON object with the cycle at which it acted:
`move` (mm/s, rad/s of each device, after the drives' limits), `stop` (and why), `exposure`, `contrast`, and every
quarter of a second `check`, a hash of wire and catheters, which `replayed` proves.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from endopilot import __version__
from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.cockpit.world import LiveWorld
from endopilot.devices.stack import Proximals
from endopilot.errors import InputError
from endopilot.files import json_text, reading
from endopilot.navigation.loop import LoopConfig
from endopilot.settings import CountOrZero, from_record, settings
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.types import Anatomy

FORMAT = "endopilot cockpit 4"
SUFFIX = ".cockpit.jsonl"
CHECK_S = 0.25  # time from one check to the next, s


@settings
class Where:
    """Where a session takes place: in the folder of an anatomy, or in patient `place` of a task of the ladder."""

    patient: Path | None = None
    task: str | None = None
    place: CountOrZero = 0


class Recorder:
    """Writes a session while it goes on."""

    def __init__(self, path: Path, world: LiveWorld, where: Where, seed: int) -> None:
        """Begin a new file, or go on with one that was resumed; InputError if it cannot be written."""
        self.path, self._world = path, world
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            new = not path.exists()
            self._stream = path.open("a", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another folder") from error
        if new:
            self._write(_header(world, where, seed))

    def event(self, **what: Any) -> None:
        """Write an event of this cycle."""
        self._write({"at": self._world.cycle} | what)

    def cycle(self) -> None:
        """Write a check where one is due; call it after each cycle."""
        if self._world.cycle % _between_checks(self._world.config) == 0:
            self.event(check=self._world.digest())

    def close(self) -> None:
        """Write a last check and close the file."""
        if not self._stream.closed:
            self.event(check=self._world.digest())
            self._stream.close()

    def _write(self, line: dict[str, Any]) -> None:
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


@dataclass(frozen=True, eq=False)
class RecordedSession:
    """A session that was recorded: vessel, wire, target and start, and the seed of the encoders' noise."""

    path: Path
    navigation: Navigation
    config: LoopConfig
    reality: World
    seed: int
    where: Where
    events: tuple[dict[str, Any], ...]
    cycles: int


def read_session(path: Path) -> RecordedSession:
    """Read a session, without a half-written last line; InputError for none, or one whose vessel is gone or changed."""
    lines = _lines(path)
    header = lines[0] if lines else {}
    if str(header.get("format")).startswith("endopilot cockpit ") and header["format"] != FORMAT:
        raise InputError(
            f"{path}: a session of endopilot {header.get('version')}, whose loop differs; replay it with that version"
        )
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: no session of the cockpit; give a file that ends in {SUFFIX}")
    with reading(path, "choose another session"):
        where = from_record(Where, header["where"])
        anatomy = _anatomy(path, header["identity"], where)
        navigation = from_record(Navigation, header["navigation"] | {"anatomy": anatomy, "robot": None})
        events = tuple(lines[1:])
        np.random.default_rng(int(header["seed"]))  # which must not be negative
        for event in events:
            _check(event)
        config, reality = from_record(LoopConfig, header["config"]), from_record(World, header["world"])
        at = np.array([0, *(int(event["at"]) for event in events)])
        between = _between_checks(config)
        if (apart := np.diff(np.sort(at)).max(initial=0)) > between:
            raise InputError(f"{apart} cycles without a check, which is due after {between}")
        cycles = int(at.max())
        return RecordedSession(path, navigation, config, reality, int(header["seed"]), where, events, cycles)


def _between_checks(config: LoopConfig) -> int:
    return max(1, round(CHECK_S / config.cycle_s))


def replayed(recording: RecordedSession) -> Iterator[tuple[LiveWorld, list[dict[str, Any]]]]:
    """Drive a session again and yield the world before the first cycle and after each, with the events of that cycle.
    Raises InputError where the wire is not where it was: another version of endopilot, or another processor."""
    world = LiveWorld(recording.navigation, recording.config, seed=recording.seed, reality=recording.reality)
    at: dict[int, list[dict[str, Any]]] = {}
    for event in recording.events:
        at.setdefault(int(event["at"]), []).append(event)
    for cycle in range(recording.cycles + 1):
        events = at.get(cycle, [])
        for event in events:
            if "exposure" in event:
                world.loop.exposed()
            if event.get("check", "") not in ("", world.digest()):
                raise InputError(
                    f"{recording.path}: at {world.time_s:g} s the wire is not where it was; "
                    f"replay it with the version and on the kind of processor that recorded it"
                )
            if "move" in event:
                world.command(moved(event))
            elif "stop" in event:
                world.stop()
        yield world, events
        if cycle < recording.cycles:
            world.advance()


def moved(event: dict[str, Any]) -> Proximals:
    """Return the velocities of a `move`, a pair for each device."""
    return tuple(zip(event["move"][::2], event["move"][1::2], strict=True))


def _check(event: dict[str, Any]) -> None:
    """Take an event apart as those who read it do; what is odd in it raises some error."""
    if "target" in event:
        branch, abscissa = event["target"]
        Target(branch=branch, abscissa=abscissa)
    if "move" in event:
        [(float(translation), float(rotation)) for translation, rotation in moved(event)]
    if "exposure" in event:
        float(event["exposure"] + event["seconds"] + event["kerma_ugy"])


def _header(world: LiveWorld, where: Where, seed: int) -> dict[str, Any]:
    navigation = world.navigation
    about = {"format": FORMAT, "version": __version__, "identity": navigation.anatomy.identity}
    about |= {"where": replace(where, patient=where.patient and where.patient.resolve())}
    given = [field.name for field in fields(navigation) if field.name not in ("anatomy", "robot")]
    about |= {"navigation": {name: getattr(navigation, name) for name in given}}
    return json.loads(json_text(about | {"config": world.config, "world": world.reality, "seed": seed}))


def _anatomy(path: Path, identity: str, where: Where) -> Anatomy:
    if where.task is not None:
        from endopilot.tasks.task import task_by_hand  # slow to import, and needed for tasks alone

        anatomy = task_by_hand(where.task).ladder_navigation(where.place).anatomy
    elif where.patient is not None:
        anatomy = read_anatomy(where.patient)
    else:
        raise InputError(f"{path}: names no patient and no task; choose another session")
    if anatomy.identity != identity:
        raise InputError(f"{path}: {anatomy.name} is another vessel now; bring the one back that it was recorded in")
    return anatomy


def _lines(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a session of the cockpit") from error
    lines = []
    for line in text.splitlines(keepends=True):
        try:
            content = json.loads(line) if line.endswith("\n") else None  # half-written
        except (json.JSONDecodeError, RecursionError):
            content = None
        if not isinstance(content, dict):
            break
        lines.append(content)
    return lines


def write_session_episode(session: str | Path, *, output: str | Path) -> None:
    """Write a recorded session, driven again and sampled every 0.5 s, as a data set of one episode, and a task's vessel
    beside it, into `OUTPUT-anatomy`. Raises InputError for no such session, one shorter than a sample, or an output
    folder that holds something else."""
    from endopilot.dataset.generate import write_episode  # an extra brings its libraries

    session, output = Path(session), Path(output)
    recording = read_session(session)
    per_sample = round(DECISION_PERIOD_S / recording.config.cycle_s)
    samples = recording.cycles // per_sample
    if samples == 0:
        raise InputError(f"{session}: lasts less than {DECISION_PERIOD_S:g} s; drive for longer")
    targets = [event["target"] for event in recording.events if "target" in event]
    navigation, reality = recording.navigation, recording.reality
    *_, (world, _events) = replayed(recording)
    cycles = world.loop.robot.recorder.trajectory().samples(slice(samples * per_sample))
    folder = recording.where.patient
    if folder is None:
        folder = output.with_name(f"{output.name}-anatomy")
        write_anatomy(navigation.anatomy, output=folder)
    target = targets[-1] if targets else [navigation.target.branch, navigation.target.abscissa]
    write_episode(
        cycles.every(per_sample),
        folder,
        output,
        navigation.stack,
        task="navigation by hand",
        tip_stiffness_factor=reality.tip_stiffness_factor,
        seed=recording.seed,
        origin={"session": session.name, "target_branch": int(target[0]), "target_mm": float(target[1])},
    )
