"""What a command line asks for, opened: a patient, a task of the ladder, a session to go on with, or a replay."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from endopilot.anatomy.io import read_anatomy, write_anatomy
from endopilot.cockpit.film import FRAME_S
from endopilot.cockpit.fluoroscopy import XrayUnit
from endopilot.cockpit.frames import scene
from endopilot.cockpit.recording import SUFFIX, Recorder, Where, read_session, replayed
from endopilot.cockpit.session import Session, Stage
from endopilot.cockpit.world import BY_HAND, LiveWorld
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.navigation.policies import POLICIES
from endopilot.tasks.navigation import Navigation, Target
from endopilot.types import Anatomy, Volume
from endopilot.xray.image import XrayImager

if TYPE_CHECKING:
    from endopilot.cockpit.game import Attempt

_START_MM = 5.0
_DEEP = 0.8  # where the first target lies, as a share of the longest path


@dataclass(frozen=True, eq=False)
class Opened:
    """What the server needs; the recording is where the session is kept, None for a replay."""

    stage: Stage
    scene: Callable[[], bytes]
    cycle_s: float
    recording: Path | None


def open_session(
    patient: Path | None = None,
    *,
    device: str = "workhorse-014",
    catheters: Sequence[str] = (),
    robot: RobotConfig = BY_HAND.robot,
    ct: Path | None = None,
    output: Path = Path("runs/cockpit"),
) -> Opened:
    """Open a patient (a synthetic one, written into `output`, if no folder is given) to be driven by hand or policy,
    with the CT as X-ray's background. Raises InputError for a missing or bad file, or a device that does not fit."""
    patient = patient or _synthetic(output)
    navigation = _start_of(read_anatomy(patient), Stack.of(device, *catheters))
    return _driven(LiveWorld(navigation, replace(BY_HAND, robot=robot)), Where(patient=patient), output, ct)


def open_task(
    name: str, place: int = 0, *, robot: RobotConfig = BY_HAND.robot, output: Path = Path("runs/cockpit")
) -> Opened:
    """Open a task of the ladder, in patient `place` of its list, to be driven by hand under X-ray alone. The agent,
    whose score stands beside a person's, drives the same robot. Raises InputError for an unknown task or patient."""
    tried = _attempt(name, place, robot)
    where = Where(task=name, place=place)
    return _driven(tried.world(), where, output, None, seed=tried.seed, make=tried.session)


def open_replay(
    path: Path, patient: Path | None = None, *, world: int = 0, task: str | None = None, ct: Path | None = None
) -> Opened:
    """Open what was recorded, simulated, planned or scored (`film.open_film`), to be looked at with a time slider; the
    CT is for the X-ray's background."""
    from endopilot.cockpit.film import ReplayStage, open_film  # slow to import, and needed for replays alone

    film = open_film(path, patient, world=world, task=task)
    navigation = film.navigation
    stage = ReplayStage(film, xray_unit(navigation, read_ct(ct)))
    return Opened(stage, scene_of(navigation, {}), FRAME_S, None)


def resume_session(path: Path, *, ct: Path | None = None) -> Opened:
    """Go on with a session that a killed server left, driven again up to its last event, and recorded on; a task that
    was not over waits for the page's start. Raises InputError for none, or one that does not replay to the bit."""
    recording = read_session(path)
    history = replayed(recording)
    first = next(history)
    with path.open("rb+") as stream:  # without what a killed server left behind its last whole line
        stream.truncate(stream.read().rfind(b"\n") + 1)
    where, make = recording.where, Session
    if where.task is not None and not any("score" in event for event in recording.events):
        make = _attempt(where.task, where.place, recording.config.robot).session
    opened = _driven(first[0], where, path.parent, ct, path=path, seed=recording.seed, make=make)
    assert isinstance(opened.stage, Session)
    opened.stage.restore(chain([first], history))
    return opened


def _attempt(task: str, place: int, robot: RobotConfig) -> Attempt:
    from endopilot.cockpit.game import Attempt  # slow to import, and needed for tasks alone
    from endopilot.tasks.task import task_by_hand

    return Attempt(task_by_hand(task), place, robot)


def _driven(
    world: LiveWorld,
    where: Where,
    output: Path,
    ct: Path | None,
    *,
    path: Path | None = None,
    seed: int = 0,
    make: Callable[..., Session] = Session,
) -> Opened:
    navigation = world.navigation
    name = f"{where.task or navigation.anatomy.name}-{datetime.now():%Y%m%d-%H%M%S-%f}{SUFFIX}"
    recorder = Recorder(path or output / name, world, where, seed)
    policies = POLICIES.names()
    session = make(world, xray_unit(navigation, read_ct(ct)), recorder, policies)
    return Opened(session, scene_of(navigation, {"policies": policies}), world.config.cycle_s, recorder.path)


def xray_unit(navigation: Navigation, ct: Volume | None) -> XrayUnit:
    """Return the X-ray unit around a navigation's patient, with a CT of theirs or without."""
    anatomy, stack = navigation.anatomy, navigation.stack
    return XrayUnit(anatomy, lambda volume: XrayImager(anatomy, stack, ct=volume), ct)


def scene_of(navigation: Navigation, about: dict[str, Any]) -> Callable[[], bytes]:
    """Return what makes the message of the scene; it is begun at once, and made once."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(scene, navigation, about)
    pool.shutdown(wait=False)
    return future.result


def read_ct(path: Path | None) -> Volume | None:
    """Read a CT, HU, if one is given; InputError if it cannot be read."""
    if path is None:
        return None
    from endopilot.imaging.volume import read_volume  # slow to import

    volume = read_volume(path)
    for note in volume.notes:
        print(note, file=sys.stderr)
    return volume


def _start_of(anatomy: Anatomy, stack: Stack) -> Navigation:
    tree = anatomy.tree
    leaf = tree.longest_leaf()
    line = tree.branches[leaf].centerline.abscissa
    target = Target(branch=leaf, abscissa=float(max(_DEEP * line[-1], line[0])))
    return Navigation(
        anatomy=anatomy, device=stack.wire, target=target, catheters=stack.catheters, start_inserted_length_mm=_START_MM
    )


def _synthetic(output: Path) -> Path:
    folder = output / "synthetic"
    if not (folder / "anatomy.json").exists():
        from endopilot.tasks.task import reference_navigation

        write_anatomy(reference_navigation().anatomy, output=folder)
    return folder
