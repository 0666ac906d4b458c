"""What can be replayed, as a `Film`: the wire every 50 ms, driven again by the recorded commands of a session,
trajectory, episode or navigation while the page shows its begin."""

from __future__ import annotations

import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.io import read_anatomy
from endopilot.cockpit import messages
from endopilot.cockpit.fluoroscopy import XrayUnit
from endopilot.cockpit.frames import device_arrays, encode, motion_values, tip_values
from endopilot.cockpit.recording import SUFFIX, read_session, replayed
from endopilot.cockpit.world import Snapshot, loop_snapshot, take_snapshot
from endopilot.control.plan_file import read_plan
from endopilot.dataset.loader import read_dataset
from endopilot.errors import InputError
from endopilot.files import reading, write_whole, writing
from endopilot.ladder.attempt import Recording, begun, navigation_seed
from endopilot.ladder.submission import recorded_navigation
from endopilot.progress import progress
from endopilot.runs import Place
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import TRAJECTORY, SimulationSetUp, Trajectory, read_trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.task import Task

FRAME_S = 0.05  # time from one frame of a film to the next, s
EVERY = 4
"""Frames of a film, of 0.05 s, from one in the file to the next."""
_ONE = """<Model id="vtkMRMLModelNode{0}" name="Wire" references="storage:vtkMRMLModelStorageNode{0};"></Model>
<ModelStorage id="vtkMRMLModelStorageNode{0}" fileName="Data/Wire_{0}.vtp" coordinateSystem="LPS"></ModelStorage>"""
_ALL = """<?xml version="1.0" encoding="UTF-8"?>
<MRML version="Slicer 5.0.0 30822" userTags="">
{models}
<Sequence id="vtkMRMLSequenceNodeSequenceIndex" name="Sequence" singletonTag="SequenceIndex" indexName="time"
 indexUnit="s" indexType="numeric" numericIndexValueTolerance="0.001" indexValues="{times}"></Sequence>
</MRML>
"""


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """The world at one moment of a film, and the largest wall force on one node so far, N."""

    snapshot: Snapshot
    exposed: bool = False
    peak_n: float = 0.0


@dataclass(eq=False)
class Film:
    """A navigation driven again in a thread of its own: its frames so far, and why it ended early, in a line."""

    navigation: Navigation
    seconds: float
    title: str
    make: Callable[[], Iterator[FilmFrame]]
    frames: list[FilmFrame] = field(default_factory=list)
    done: bool = False
    failure: str = ""

    def start(self) -> None:
        """Begin to drive."""
        threading.Thread(target=self._drive, name="film", daemon=True).start()

    def _drive(self) -> None:
        try:
            peak_n = 0.0
            for frame in self.make():
                peak_n = max(peak_n, frame.snapshot.force_n)
                self.frames.append(replace(frame, peak_n=peak_n))
        except Exception as error:  # shown in the page
            self.failure = " ".join(str(error).split())
        self.done = True


def open_film(path: Path, patient: Path | None = None, *, world: int = 0, task: str | None = None) -> Film:
    """Open what is to be replayed: a session (.cockpit.jsonl), a trajectory (.npz), a folder of a plan, of `endopilot
    navigate` or of a data set, a submission.json, or a ladder's result, `task` being of its files; `world` is a
    trajectory's, an episode, or a task's patient. Raises InputError where it cannot be read, or lacks its patient or
    task."""
    if path.name.endswith(SUFFIX):
        return _session(path)
    if (path / "meta").is_dir():
        with reading(path, "make the data set again"):
            data = read_dataset(path)[world]
            return _film(data.set_up(), data.command[0], data.sample_period_s, {}, f"episode {world} of {path.name}")
    if path.suffix.lower() == ".json":
        with reading(path, "give a file of the ladder as it was written"):
            return _of_the_ladder(*recorded_navigation(path, task, world))
    recorded = path / TRAJECTORY if path.is_dir() else path
    if recorded.suffix.lower() != ".npz" or not recorded.exists():
        raise InputError(
            f"{path}: cannot be replayed; give a session ({SUFFIX}), a trajectory (.npz), a folder of a plan, a "
            "navigation or a data set, or a file of the ladder (.json)"
        )
    if patient is None:
        raise InputError(f"{path}: give the patient's folder too: endopilot cockpit PATIENT --replay {path}")
    vessel = read_anatomy(patient)
    if (path / "plan.csv").exists():
        return _of_trajectory(read_plan(path, vessel), 0, f"plan {path.name}")
    trajectory = read_trajectory(recorded, anatomy=vessel)
    worlds = len(trajectory.valid)
    if not 0 <= world < worlds:
        raise InputError(f"world: {world}; {path} has worlds 0 to {worlds - 1}")
    return _of_trajectory(trajectory, world, f"{path.name}, world {world}")


def _session(path: Path) -> Film:
    recording = read_session(path)
    every = max(round(FRAME_S / recording.config.cycle_s), 1)
    target = next((event["target"] for event in reversed(recording.events) if "target" in event), None)
    navigation = recording.navigation
    if target is not None:
        navigation = replace(navigation, target=Target(branch=target[0], abscissa=target[1]))

    def make() -> Iterator[FilmFrame]:
        exposed = False
        for world, events in replayed(recording):
            exposed |= any("exposure" in event for event in events)
            if world.cycle % every == 0:
                yield FilmFrame(world.snapshot(), exposed)
                exposed = False

    return Film(navigation, recording.cycles * recording.config.cycle_s, f"session {path.name}", make)


def _of_the_ladder(task: Task, place: int, recording: Recording) -> Film:
    navigation, periods = task.ladder_navigation(place), len(recording.control)

    def make() -> Iterator[FilmFrame]:
        loop = begun(recording, navigation, seed=navigation_seed(task, place))
        cycle_s, cycles = loop.config.cycle_s, loop.config.cycles
        yield FilmFrame(loop_snapshot(loop, cycle=0, force_n=float(loop.simulator.contacts.max())), True)
        for number in range(1, periods * cycles + 1):
            if loop.between_periods:
                loop.begin()
            force_n = loop.advance(cycle_s)
            period, within = divmod(number, cycles)
            exposed = within == 0 and period < periods and bool(recording.exposed[period])
            yield FilmFrame(loop_snapshot(loop, cycle=number, force_n=force_n), exposed)

    return Film(navigation, DECISION_PERIOD_S * periods, f"{task.title}, patient {place}", make)


def _of_trajectory(trajectory: Trajectory, world: int, title: str) -> Film:
    of_world = {name: getattr(trajectory.set_up, name)[world : world + 1] for name in _OF_WORLDS}
    set_up = replace(trajectory.set_up, **of_world)
    return _film(set_up, trajectory.command[world], trajectory.period_s, trajectory.about, title)


_OF_WORLDS = ("anatomies", "stacks", "initial", "friction")


def _film(
    set_up: SimulationSetUp,
    commands: Float[np.ndarray, "samples devices 2"],
    period_s: float,
    about: Mapping[str, Any],
    title: str,
) -> Film:
    """Return a film of one world, driven again; `about` has its `target` and `exposures_s`, if known."""
    (anatomy,), (stack,), (start,) = set_up.anatomies, set_up.stacks, set_up.initial
    if np.isnan(start).any():
        raise InputError(f"{title}: was on its way when the recording began; record from its start")
    leaf = anatomy.tree.longest_leaf()
    end = Target(branch=leaf, abscissa=float(anatomy.tree.branches[leaf].centerline.abscissa[-1]))
    navigation = Navigation(
        anatomy=anatomy,
        device=stack.wire,
        target=Target(**about["target"]) if "target" in about else end,
        catheters=stack.catheters,
    )
    parts, every = max(round(period_s / FRAME_S), 1), max(round(FRAME_S / period_s), 1)
    exposed = {round(time_s / FRAME_S) for time_s in about.get("exposures_s", ())}

    def make() -> Iterator[FilmFrame]:
        simulator = Simulator(
            anatomy, stack, actuation=set_up.actuation, motion=set_up.motion, config=replace(set_up.config, threads=1)
        )
        simulator.reset(inserted_length=start[None, :, 0], rotation=start[None, :, 1], friction=set_up.friction)
        force_n, before = 0.0, simulator.proximal[0]
        for number, command in enumerate([None, *np.repeat(commands, parts, axis=0)]):
            if command is not None:
                before = simulator.proximal[0]
                step = simulator.step([command], period_s / parts)
                force_n = max(force_n, float(step.contact_force_max[0]))
            if number % every == 0:
                moved = (simulator.proximal[0] - before) * parts / period_s
                shown = take_snapshot(
                    simulator,
                    cycle=number // every,
                    time_s=number * period_s / parts,
                    force_n=force_n,
                    velocity=tuple(moved.ravel().tolist()),
                )
                yield FilmFrame(shown, number // every in exposed)
                force_n = 0.0

    return Film(navigation, len(commands) * period_s, title, make)


def write_film(film: Film, output: Path) -> None:
    """Write wire and catheters of a film as lines, LPS mm, with the wall's force on each node, N: at its end (.vtp, a
    model), or every 0.2 s (.seq.mrb, a sequence). Raises InputError for another suffix, or a film that fails."""
    Place("file", (".seq.mrb", ".vtp")).files(output)
    with progress("Driving again", 1) as advance:
        shown = [frame.snapshot for frame in film.make()]
        advance()
    if output.suffix.lower() == ".vtp":
        return write_whole(output, _as_vtp(shown[-1]))
    chosen = shown[::EVERY]
    times = ";".join(f"vtkMRMLModelNode{number}:{each.time_s:g}" for number, each in enumerate(chosen))
    models = "\n".join(map(_ONE.format, range(len(chosen))))
    with writing(output) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Wire/Wire.mrml", _ALL.format(models=models, times=times))
        for number, each in enumerate(chosen):
            archive.writestr(f"Wire/Data/Wire_{number}.vtp", _as_vtp(each))


def _as_vtp(shown: Snapshot) -> str:
    """Return the devices at a moment as the text of a VTP file: a line each, with `Force` of each point."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    from endopilot.vessels.surface import polydata_of  # VTK is slow to import

    devices = (shown, *shown.catheters)
    offsets = np.cumsum([0, *(len(each.nodes) for each in devices)])
    polydata = polydata_of(np.concatenate([each.nodes for each in devices]), offsets, np.arange(offsets[-1]), "Lines")
    force = numpy_to_vtk(np.concatenate([each.node_force for each in devices]).astype(float), deep=True)
    force.SetName("Force")
    polydata.GetPointData().AddArray(force)
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata)
    writer.WriteToOutputStringOn()
    writer.Write()
    return writer.GetOutputString()


class ReplayStage:
    """A film in place of a session, at the index of the frame that is shown."""

    def __init__(self, film: Film, xray: XrayUnit) -> None:
        """Begin at the start; the film is driven meanwhile."""
        self.film, self._xray = film, xray
        self.playing, self.at, self._shown = True, 0, -1
        film.start()

    def handle(self, message: messages.Message, now_s: float) -> None:
        """Play, pause, seek, expose, or set the C-arm."""
        if isinstance(message, messages.Replay):
            if message.playing is not None:
                ended = self.film.done and self.at >= len(self.film.frames) - 1
                self.playing, self.at = message.playing, 0 if message.playing and ended else self.at
            if message.at_s is not None:
                self.at = max(min(round(message.at_s / FRAME_S), len(self.film.frames) - 1), 0)
                self._shown = -1
        elif isinstance(message, messages.Pedal):
            self._xray.pedal = message.down
        elif isinstance(message, messages.Contrast):
            self._xray.inject(self.film.frames[self.at].snapshot.time_s if self.film.frames else 0.0)
        elif isinstance(message, messages.CArm):
            self._xray.configure(**message.model_dump(exclude={"type"}, exclude_none=True))
        elif not isinstance(message, messages.Drive | messages.Autopilot):
            raise InputError(f"{message.type}: not in a replay")

    def halt(self, why: str) -> None:
        """Let the pedal go."""
        self._xray.pedal = False

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Show the next frame."""
        if not self.film.frames:
            return []
        self.at = min(self.at, len(self.film.frames) - 1)
        frame = self.film.frames[self.at]
        sent = self._xray.pulse(frame.snapshot)
        if self._xray.ready:
            if not sent and frame.exposed and self._shown != self.at:
                sent = self._xray.expose(frame.snapshot)
            self._shown = self.at
        sent.append(("state", encode("state", self._values(), **device_arrays(frame.snapshot))))
        if self.playing and self.at + 1 < len(self.film.frames):
            self.at += 1
        elif self.playing and self.film.done:
            self.playing = False
        return sent

    def close(self) -> None:
        """End it."""
        self._xray.close()

    def _values(self) -> dict[str, Any]:
        film, snapshot = self.film, self.film.frames[self.at].snapshot
        anatomy = film.navigation.anatomy
        return {
            "mode": "replay",
            **motion_values(snapshot),
            **self._xray.seen(snapshot.time_s, film.navigation.target),
            "command": snapshot.velocity,
            "stopped": "",
            "peak_force_n": round(film.frames[self.at].peak_n, 4),
            "sight": True,
            "replay": {
                "title": film.title,
                "seconds": round(film.seconds, 3),
                "ready_s": round(film.frames[-1].snapshot.time_s, 2),
                "playing": self.playing,
                "failure": film.failure,
            },
        } | tip_values(anatomy, snapshot)
