"""The file by which others can confirm scores of the ladder: `write_submission`, `check_submission`.

It holds the scores, the results and the recording of every navigation, and what they were made with. The check drives
every recording through the same robot and simulator, without the policy, and compares all figures to the bit.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from threadpoolctl import threadpool_info

from endopilot import __version__, _core
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.files import input_hash, json_text, manifest, read_json, write_json
from endopilot.ladder.attempt import Recording, navigation_seed, repeat
from endopilot.ladder.scores import score, timeless
from endopilot.navigation.policies import POLICIES
from endopilot.parallel import each
from endopilot.settings import CountOrZero, Seed, from_record, read_settings, settings
from endopilot.simulation.world import World
from endopilot.tasks.task import LadderVersion, Task, find_task, list_tasks

SUBMISSION_FILE = "submission.json"
_ROUNDING = 0.05
"""Figures that differ by no larger share agree but for rounding. In 232 navigations with another kernel the largest
force differed by 1e-8 in the median and by 3.4 % at most, where a tip snaps otherwise, and paths by 0.07 %."""
MOST_PATIENTS = 100
"""Patients of each task, at most: their seeds are distinct up to there (`navigation_seed`)."""


@settings
class PackedRecording:
    """A `Recording` as text."""

    control: str
    exposed: str
    believed_mm: str | None = None
    gave_up: bool = False


@settings
class NavigationEntry:
    """One navigation: its figures (`endopilot.ladder.attempt.attempt`) and its recording."""

    patient: str
    seed: Seed
    success: bool
    safe: bool
    reason: Literal["reached", "time", "invalid", "gave up"]
    seconds: float
    path_ratio: float
    peak_force_n: float
    exposures: CountOrZero
    near: bool | None = None
    events: tuple[CountOrZero, CountOrZero] | None = None
    sha256: str
    recording: PackedRecording

    def figures(self) -> dict[str, Any]:
        """Return what driving the recording again must give."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return {name: value for name, value in given.items() if name not in ("seed", "recording")}


@settings
class Submission:
    """What a policy did on the ladder, and how that can be done again.

    Attributes:
        ladder: version of the ladder; a file without it is one of version 1.
        origin: package and version that it comes from, or its file and the SHA-256 of that.
        versions: of endopilot, Python and libraries.
        core: processor level that the rod core was built for.
        blas: kernel of linear algebra of numpy and SciPy, such as openblas Haswell; none in older files.
        tasks: name of each task and the SHA-256 of its definition with its device.
        navigations: by the task's name, in the order of the task's patients.
        scores: what `endopilot.ladder.scores.score` makes of them.
        robot: what drove; a file without it has the default one.
        world: what reality was; a file without it has the nominal one.
    """

    format: Literal[1] = 1
    ladder: LadderVersion | None = None
    policy: str
    origin: str
    versions: dict[str, str | None]
    core: str
    blas: str | None = None
    tasks: dict[str, str]
    navigations: dict[str, tuple[NavigationEntry, ...]]
    scores: tuple[dict[str, Any], ...]
    robot: RobotConfig = RobotConfig()
    world: World = World()

    @property
    def version(self) -> LadderVersion:
        """Version of the ladder."""
        return self.ladder or 1


@dataclass(frozen=True)
class SubmissionCheck:
    """What came of the check of a submission.

    Attributes:
        policy: name of the policy.
        origin: where the policy comes from, as the file says.
        navigations: their number.
        difference: the first that differs from the file, in words; None where all scores are confirmed to the bit.
        rounded: whether all figures agree but for rounding, in an installation with another kernel of linear algebra.
        remarks: in what this installation differs from the one that made the file.
    """

    policy: str
    origin: str
    navigations: int
    difference: str | None
    rounded: bool
    remarks: tuple[str, ...]

    @property
    def confirmed(self) -> bool:
        """Whether the scores are what the recordings give: to the bit, or, with another kernel, but for rounding."""
        return self.difference is None or self.rounded


def blas_kernel() -> str | None:
    """Return which kernel of linear algebra numpy and SciPy run here, such as openblas Haswell; None if it is not told.

    Vessels differ by it in their last bits, and so does what is driven in them.
    """
    loaded = [each for each in threadpool_info() if each["user_api"] == "blas"]
    kernels = {f"{each['internal_api']} {each.get('architecture', '')}".strip() for each in loaded}
    return ", ".join(sorted(kernels)) or None


def task_digest(task: Task) -> str:
    """Return the SHA-256 of what a task's navigations follow from: its definition and its devices."""
    # Older tasks had no such fields, or named them otherwise: their hashes stay.
    older = {"vessel": "anatomy", "start_inserted_length_mm": "start_inserted_mm"}
    definition = {
        older.get(name, name): value
        for name, value in asdict(task).items()
        if (name, value) != ("version", 1) and value is not None
    }
    if task.anatomies is not None:
        hashes = [next(iter(input_hash(Path(folder)).values())) for folder in task.anatomies]
        definition |= {"anatomies": hashes, "device": None}  # what they hold, wherever they lie
        definition |= {"catheter": None} if task.catheter else {}
    content = json_text(definition) + json_text(read_wire(task.device))
    content += json_text(read_catheter(task.catheter)) if task.catheter else ""
    return hashlib.sha256(content.encode()).hexdigest()


def write_submission(
    path: Path,
    policy: str,
    version: LadderVersion,
    results: Mapping[str, Sequence[Mapping[str, Any]]],
    scores: Sequence[Mapping[str, Any]],
    robot: RobotConfig,
    world: World,
) -> None:
    """Write the submission file of a policy.

    Args:
        results: by the task's name, the results of its navigations (`attempt`) in the order of the task's patients.
    """
    known = {each.name for each in fields(NavigationEntry)}
    submission = Submission(
        ladder=version,
        policy=policy,
        origin=POLICIES.origin(policy),
        versions=manifest(config=None)["versions"],
        core=_core.LEVEL,
        blas=blas_kernel(),
        tasks={name: task_digest(find_task(name, version=version)) for name in results},
        navigations={
            name: tuple(NavigationEntry(**{key: value for key, value in one.items() if key in known}) for one in done)
            for name, done in results.items()
        },
        scores=tuple(timeless(row) for row in scores),
        robot=robot,
        world=world,
    )
    write_json(path, submission)


def read_submission(path: str | Path) -> Submission:
    """Read a submission file, whose scores are not checked.

    Raises:
        InputError: the file is no submission, or its tasks or seeds are not those of this ladder.
    """
    path = Path(path)
    submission = read_settings(path, Submission, remedy="give a submission.json of `endopilot ladder`")
    _refuse_another_ladder(path, submission)
    return submission


def check_submission(path: str | Path) -> SubmissionCheck:
    """Drive all recordings of a submission file again, without the policy, and compare every figure to the bit.

    With another kernel of linear algebra vessels differ in their last bits, and so does what is driven in them. Figures
    that agree but for rounding are told from others there.

    Args:
        path: the file.

    Raises:
        InputError: the file is no submission, or its tasks or seeds are not those of this ladder.
    """
    submission = read_submission(path)
    with tempfile.TemporaryDirectory(prefix="endopilot-") as folder:
        difference, rounding = _first_difference(submission, Path(folder))
    return SubmissionCheck(
        policy=submission.policy,
        origin=submission.origin,
        navigations=sum(map(len, submission.navigations.values())),
        difference=difference,
        rounded=rounding and submission.blas != blas_kernel(),
        remarks=_remarks(submission),
    )


def _refuse_another_ladder(path: Path, submission: Submission) -> None:
    """Refuse tasks, patients or seeds that are not those of this ladder: the replay alone would not show a seed."""
    if set(submission.tasks) != set(submission.navigations):
        raise InputError(f"{path}: tasks and navigations name different tasks; give the file as it was written")
    counts = {name: len(entries) for name, entries in submission.navigations.items()}
    tasks = {}
    for name in counts:
        try:
            tasks[name] = find_task(name, version=submission.version)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    most = max(counts.values(), default=0)
    known = max((len(task.ladder.numbers) for task in tasks.values()), default=0)
    whole = all(1 <= counts[name] == min(most, len(task.ladder.numbers)) for name, task in tasks.items())
    if not counts or not whole:
        raise InputError(f"{path}: navigations: {counts}; each task needs the same first 1 to {known} patients")
    for name, entries in submission.navigations.items():
        if submission.tasks[name] != task_digest(tasks[name]):
            if isinstance(submission.version, str) and Path(submission.version).is_dir():
                raise InputError(
                    f"{path}: task {name!r} of {submission.version} is another than the file was made with: its "
                    "definition, a device or an anatomy has changed; check it with the folder as it was"
                )
            raise InputError(
                f"{path}: task {name!r} is not the one of endopilot {__version__}; the file was made with endopilot "
                f"{submission.versions.get('endopilot')}, check it with that"
            )
        for place, entry in enumerate(entries):
            if entry.seed != (seed := navigation_seed(tasks[name], place)):
                raise InputError(f"{path}: task {name}, patient {place}: seed {entry.seed}; the ladder's is {seed}")


def _first_difference(submission: Submission, folder: Path) -> tuple[str | None, bool]:
    """Return where the file first differs from its recordings driven again, in words, and whether by rounding alone."""
    entries = {
        folder / name / f"{place:02d}.json": entry
        for name, done in sorted(
            submission.navigations.items(), key=lambda item: find_task(item[0], version=submission.version).level
        )
        for place, entry in enumerate(done)
    }
    for path, entry in entries.items():
        write_json(path, entry.recording)
    again = partial(_repeat, version=submission.version, robot=submission.robot, world=submission.world)
    bad = each(f"Checking {submission.policy}", list(entries), again)
    differing, rounding = [], True
    for path, entry in entries.items():
        again = {} if path in bad else read_json(path)
        remark = str(bad[path]) if path in bad else _difference(entry.figures(), again)
        if remark is not None:
            differing.append(f"task {path.parent.name}, patient {int(path.stem)}: {remark}")
            rounding = rounding and _agree(entry.figures(), again)
    if differing and not rounding:
        return f"{differing[0]} ({len(differing)} of {len(entries)} navigations differ)", False
    results = {
        name: [read_json(folder / name / f"{place:02d}.json") for place in range(len(done))]
        for name, done in submission.navigations.items()
    }
    rows = score([task for task in list_tasks(submission.version) if task.name in results], results)
    for given, again in zip_longest(submission.scores, rows, fillvalue={}):
        remark = _difference(given, again)
        if remark is not None and not (differing and _agree(given, again)):
            return f"scores, {again.get('task') or given.get('task')}: {remark}", False
    if differing:
        return f"{differing[0]} ({len(differing)} of {len(entries)} navigations differ)", True
    return None, False


def recorded_navigation(path: Path, name: str | None, place: int) -> tuple[Task, int, Recording]:
    """Return what was recorded of one navigation, from a submission or from a result file of a ladder's folder.

    Args:
        path: a submission.json or TASK/NUMBER.json.
        place: of the patient in the task's list, likewise.

    Returns:
        The task, the patient's place in its list, and the recording.

    Raises:
        InputError: the file is none of the ladder, or has no such navigation.
    """
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
    task = find_task(name, version=content.get("ladder") or 1)
    robot = from_record(RobotConfig, content["robot"]) if "robot" in content else None
    world = from_record(World, content["world"]) if "world" in content else None
    return task, place, Recording.unpacked(entry["recording"], 2 if task.catheter else 1, robot, world)


def _repeat(path: Path, *, version: LadderVersion, robot: RobotConfig, world: World) -> None:
    """Drive the recording in a file again, and put the figures in its place."""
    task, place = find_task(path.parent.name, version=version), int(path.stem)
    navigation = task.ladder_navigation(place)
    recording = Recording.unpacked(read_json(path), len(navigation.devices), robot, world)
    figures = repeat(recording, navigation, seed=navigation_seed(task, place))
    write_json(path, {"patient": navigation.anatomy.name} | figures)


def _difference(given: Mapping[str, Any], again: Mapping[str, Any]) -> str | None:
    """Return the first value that differs, in words; as text, so that a NaN equals a NaN."""
    for name in [*again, *given]:
        before, now = (json_text(values.get(name, "absent")) for values in (given, again))
        if before != now and name == "sha256":
            return "decisions or course are not those that the file's hash was made of"
        if before != now:
            return f"{name} is {before} in the file and {now} when driven again"
    return None


def _agree(given: Mapping[str, Any], again: Mapping[str, Any]) -> bool:
    """Return whether figures agree but for rounding; the hash of what is driven does not count."""
    names = {*given, *again} - {"sha256"}
    if not all(name in given and name in again for name in names):
        return False
    floats = {name for name in names if isinstance(given[name], float) and isinstance(again[name], float)}
    close = all(math.isclose(given[name], again[name], rel_tol=_ROUNDING) for name in floats)
    return close and all(json_text(given[name]) == json_text(again[name]) for name in names - floats)


def _remarks(submission: Submission) -> tuple[str, ...]:
    """Return in what this installation differs from the one that made the file."""
    here = {**manifest(config=None)["versions"], "core": _core.LEVEL, "blas": blas_kernel()}
    made = {**submission.versions, "core": submission.core, "blas": submission.blas}
    return tuple(
        f"made with {name} {made.get(name)}, checked with {value}"
        for name, value in here.items()
        if made.get(name) != value
    )
