"""What can be replayed: a session, a rollout, a plan, an episode of a data set, a navigation of the ladder.

Each becomes a `Film`: the wire every 50 ms, driven again by its recorded controls while the page shows its begin.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.io import read_anatomy
from endopilot.cockpit.recording import SUFFIX, read_recording, replayed
from endopilot.cockpit.world import Snapshot, take_snapshot
from endopilot.control.plan_file import read_plan
from endopilot.dataset.loader import load_dataset
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_device
from endopilot.errors import InputError
from endopilot.files import read_json, reading
from endopilot.ladder.attempt import Recording, Repeated, navigation_seed
from endopilot.navigation.navigate import NavigateConfig, NavigationLoop
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import read_controls_csv
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.task import CORE, find_task
from endopilot.types import Anatomy

FRAME_S = 0.05
"""Time from one frame of a film to the next, s."""


@dataclass(frozen=True, eq=False)
class Frame:
    """The world at one moment of a film.

    Attributes:
        snapshot: the world.
        exposed: whether X-ray was on.
        peak_n: largest wall force on one node so far, N.
    """

    snapshot: Snapshot
    exposed: bool = False
    peak_n: float = 0.0


@dataclass(eq=False)
class Film:
    """A navigation that is driven again, frame by frame, in a thread of its own.

    Attributes:
        navigation: vessel, wire and target.
        seconds: how long it lasts, s.
        title: what it is, for the page.
        frames: those that are there so far.
        done: whether all are.
        failure: why it ended early, in a line; empty if it did not.
    """

    navigation: Navigation
    seconds: float
    title: str
    make: Callable[[], Iterator[Frame]]
    frames: list[Frame] = field(default_factory=list)
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
        except Exception as error:  # told in the page
            self.failure = " ".join(str(error).split())
        self.done = True


def open_film(
    path: Path,
    patient: Path | None = None,
    *,
    device: str = "workhorse-014",
    catheters: Sequence[str] = (),
    world: int = 0,
    task: str | None = None,
) -> Film:
    """Open what is to be replayed.

    Args:
        path: a session (.cockpit.jsonl); a rollout or controls (.csv); a folder of a plan, of `endopilot navigate` or
            of a data set; a submission.json, or a navigation's result of the ladder.
        patient: folder of the anatomy, for rollouts and plans.
        device: wire of a rollout or plan.
        catheters: around it, from the inside out.
        world: which of a rollout's worlds, a data set's episodes, or a task's patients.
        task: of the ladder's files.

    Raises:
        InputError: it cannot be read, or lacks its patient or task.
    """
    if path.name.endswith(SUFFIX):
        return _session(path)
    if (path / "plan.csv").exists():
        around = tuple(read_catheter(name) for name in catheters)
        plan = read_plan(path, read_anatomy(_given(patient, path)), read_device(device), around)
        start = plan.navigation.start
        return _controls(plan.navigation, start, plan.control, DECISION_PERIOD_S, f"plan {path.name}")
    if (path / "navigation.csv").exists():
        vessel, files = read_anatomy(_given(patient, path)), sorted(path.glob("catheter-*.yaml"))
        return _rollout(path / "controls.csv", vessel, str(path / "wire.yaml"), list(map(str, files)), 0)
    if (path / "meta").is_dir():
        with reading(path, "make the data set again"):
            return _episode(path, world)
    if path.suffix == ".json":
        with reading(path, "give a file of the ladder as it was written"):
            return _ladder(path, task, world)
    if path.suffix == ".csv":
        return _rollout(path, read_anatomy(_given(patient, path)), device, catheters, world)
    raise InputError(
        f"{path}: cannot be replayed; give a session ({SUFFIX}), a rollout (.csv), a folder of a plan, a navigation "
        "or a data set, or a file of the ladder (.json)"
    )


def _session(path: Path) -> Film:
    recording = read_recording(path)
    every = max(round(FRAME_S / recording.config.cycle_s), 1)
    target = next((event["target"] for event in reversed(recording.events) if "target" in event), None)
    navigation = recording.navigation
    if target is not None:
        navigation = replace(navigation, target=Target(branch=target[0], abscissa=target[1]))

    def make() -> Iterator[Frame]:
        exposed = False
        for world, events in replayed(recording):
            exposed |= any("exposure" in event for event in events)
            if world.cycle % every == 0:
                yield Frame(world.snapshot(), exposed)
                exposed = False

    return Film(navigation, recording.cycles * recording.config.cycle_s, f"session {path.name}", make)


def _controls(
    navigation: Navigation,
    start: Float[np.ndarray, "devices 2"],
    control: Float[np.ndarray, "n devices 2"],
    period_s: float,
    title: str,
    config: SimulatorConfig | None = None,
    friction: float | None = None,
) -> Film:
    """Return a film of controls, mm/s and rad/s of each device, each held for a period, s.

    Args:
        navigation: vessel, wire and catheters.
        start: inserted length, mm, and rotation, rad, of each device.
        control: a row a period.
        period_s: time that each is held, s.
        title: of the film.
        config: settings of the rod core.
        friction: of the wire; the device's own if not given.
    """
    parts = max(round(period_s / FRAME_S), 1)
    lengths = np.maximum(
        start[:, 0], 0.0
    )  # what was computed back from the end of a period may lie below by a rounding

    def make() -> Iterator[Frame]:
        simulator = Simulator(
            navigation.anatomy,
            navigation.stack,
            config=replace(config or SimulatorConfig(), threads=1),
        )
        own = simulator.set_up.friction.copy()
        own[:, 0] = own[:, 0] if friction is None else friction
        simulator.reset(inserted_length=lengths[None], rotation=start[None, :, 1], friction=own)
        frame = {"cycle": 0, "time_s": 0.0, "force_n": 0.0, "velocity": (0.0,) * start.size}
        yield Frame(take_snapshot(simulator, None, **frame))
        for number, velocity in enumerate(control):
            for part in range(parts):
                step = simulator.step([velocity], period_s / parts)
                frame = {
                    "cycle": number * parts + part + 1,
                    "time_s": (number + (part + 1) / parts) * period_s,
                    "force_n": float(step.contact_force_max[0]),
                    "velocity": tuple(velocity.ravel().tolist()),
                }
                yield Frame(take_snapshot(simulator, step, **frame))

    return Film(navigation, len(control) * period_s, title, make)


def _rollout(path: Path, anatomy: Anatomy, device: str, catheters: Sequence[str], world: int) -> Film:
    """Return a film of a rollout's or script's controls."""
    script = read_controls_csv(path, devices=1 + len(catheters))
    worlds = len(script.control)
    if not 0 <= world < worlds:
        raise InputError(f"world: {world}; {path} has worlds 0 to {worlds - 1}")
    start = script.initial[world]
    wire = read_device(device)
    leaf = anatomy.tree.longest_leaf()
    end = float(anatomy.tree.branches[leaf].centerline.abscissa[-1])
    navigation = Navigation(
        anatomy=anatomy,
        device=wire,
        target=Target(branch=leaf, abscissa=end),
        catheters=tuple(read_catheter(name) for name in catheters),
    )
    return _controls(navigation, start, script.control[world], script.period_s, f"rollout {path.name}, world {world}")


def _episode(folder: Path, number: int) -> Film:
    """Return a film of an episode of a data set, driven again by what the drive was commanded."""
    data = load_dataset(folder)
    if not 0 <= number < len(data):
        raise InputError(f"world: {number}; {folder} has episodes 0 to {len(data) - 1}")
    settings = data.manifest["settings"]
    anatomy = read_anatomy(data.anatomy_folder(str(data.anatomy[number])))
    wire = read_device(str(data.device[number])).with_tip(
        bend_rad=float(data.tip_bend[number]), stiffness_factor=float(data.tip_stiffness_factor[number])
    )
    branch = int(data.branch[number, -1, 0])
    line = anatomy.tree.branches[branch].centerline.abscissa
    navigation = Navigation(
        anatomy=anatomy,
        device=wire,
        target=Target(branch=branch, abscissa=float(np.clip(data.tip_abscissa[number, -1, 0], line[0], line[-1]))),
        catheters=data.stack.catheters,
    )
    config = SimulatorConfig(**(settings["config"]["simulator"] | {"threads": 1}))
    friction = float(data.friction[number])
    title = f"episode {number} of {folder.name}"
    start = data.initial[number]
    return _controls(navigation, start, data.command[number], data.sample_period_s, title, config, friction)


def _ladder(path: Path, name: str | None, place: int) -> Film:
    """Return a film of a navigation in a submission, or in a result file of a ladder's folder."""
    content = read_json(path)
    if isinstance(content, dict) and "navigations" in content:
        if name is None or name not in content["navigations"]:
            raise InputError(f"task: {name!r}; {path} has {', '.join(content['navigations'])}")
        entries = content["navigations"][name]
        if not 0 <= place < len(entries):
            raise InputError(f"world: {place}; {path} has patients 0 to {len(entries) - 1} of this task")
        entry = entries[place]
    elif isinstance(content, dict) and "recording" in content and path.stem.isdecimal():
        name, place, entry = path.parent.name, int(path.stem), content
    else:
        raise InputError(f"{path}: is no file of the ladder; give a submission.json or TASK/NUMBER.json")
    task = find_task(name, content.get("ladder") or 1)
    navigation = task.ladder_navigation(place)
    devices = len(navigation.devices)
    recording = Recording.unpacked(entry["recording"], devices)

    def make() -> Iterator[Frame]:
        config = NavigateConfig(simulator=replace(CORE, threads=1))
        loop = NavigationLoop(navigation, Repeated(recording), config=config, seed=navigation_seed(task, place))
        yield Frame(_of_loop(loop, 0.0, (0.0, 0.0) * devices))
        while loop.reason is None:
            velocity = tuple(chain.from_iterable(loop.begin().devices))
            exposed = loop.observation is not None and loop.observation.tip is not None
            while loop.reason is None and not loop.between_periods:
                peak = loop.advance(FRAME_S)
                yield Frame(_of_loop(loop, peak, velocity), exposed)
                exposed = False

    return Film(navigation, len(recording.control) * DECISION_PERIOD_S, f"{task.title}, patient {place}", make)


def _of_loop(loop: NavigationLoop, force_n: float, velocity: tuple[float, ...]) -> Snapshot:
    return take_snapshot(
        loop.simulator,
        loop.robot.last_step,
        cycle=round(loop.time_s / FRAME_S),
        time_s=loop.time_s,
        force_n=force_n,
        velocity=velocity,
    )


def _given(patient: Path | None, path: Path) -> Path:
    if patient is None:
        raise InputError(f"{path}: give the patient's folder too: endopilot cockpit PATIENT --replay {path}")
    return patient
