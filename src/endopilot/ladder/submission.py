"""The file by which others can confirm scores of the ladder: `write_submission`, `check_submission`.

It holds the scores, the results and the recording of every navigation, and what they were made with. The check believes
none of it: it drives every recording through the same robot and simulator, with a kernel of linear algebra that it
knows, compares all figures to the bit, and returns those that it drove itself.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from numpy.lib.introspect import opt_func_info
from threadpoolctl import threadpool_info

from endopilot import _core
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.files import json_text, manifest, read_json, write_json
from endopilot.ladder.attempt import Recording, attempt, navigation_seed, repeat
from endopilot.ladder.scores import decision_ms, score, submitted
from endopilot.ladder.terms import Terms, task_digest
from endopilot.navigation.policies import POLICIES
from endopilot.parallel import Workers, each
from endopilot.settings import CountOrZero, NonNegative, Seed, read_settings, settings
from endopilot.simulation.world import World
from endopilot.tasks.task import LadderVersion, Task, find_task

SUBMISSION_FILE = "submission.json"
KERNELS = {
    "openblas Haswell, numpy X86_V3": (
        "avx2",
        {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
    ),
    "openblas Haswell, numpy X86_V4": ("avx512", {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": ""}),
    "openblas SkylakeX, numpy X86_V4": ("avx512", {"OPENBLAS_CORETYPE": "SkylakeX", "NPY_DISABLE_CPU_FEATURES": ""}),
}
"""Kernels of linear algebra and of numpy's functions that submissions are driven again with, the processor level that
they need, and the variables by which libraries take them as they are loaded. Vessels differ by the kernel in their last
bits, and so does what is driven in them: a wire that snaps makes that up to 3.4 % of a force."""
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
    """What a policy did on the ladder, and how that can be done again: the SHA-256 of each task with its device, and
    its navigations in the order of its patients, which were drawn by the word `drawn`, if any (`Terms.drawn`).

    `key` must be equal for two files to be compared (`key_of`); it follows from all else here. `origin` is the package
    and version of the policy, or its file and the SHA-256 of that; `core` the processor level of the rod core, `blas`
    kernels of linear algebra and of numpy's functions (`KERNELS`). Nothing confirms `decision_ms`, how long decisions
    took, ms, median and 99th percentile: another machine takes another time."""

    format: Literal[1] = 1
    ladder: LadderVersion
    key: dict[str, Any]
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
    drawn: str | None = None
    thinking_s: NonNegative = 0.0
    decision_ms: tuple[NonNegative, NonNegative] | None = None

    @property
    def terms(self) -> Terms:
        """On what terms the policy climbed; patients follow from the file, nobody chooses them."""
        terms = Terms(self.ladder, self.robot, self.world, thinking_s=self.thinking_s)
        if self.drawn is None:
            return terms
        return terms.drawn(self.policy, self.origin, self.drawn, max(map(len, self.navigations.values()), default=0))


Verdict = Literal["decided again", "replayed", "failed", "not judged"]
"""What came of a check: all figures are confirmed, and the policy took the same decisions again; all figures but the
exposures are; something is not as the file says; or this machine cannot tell."""


def key_of(terms: Terms, counts: Mapping[str, int]) -> dict[str, Any]:
    """Return what must be equal for two submissions to be compared: terms, tasks, and the patients done of each."""
    return terms.key() | {"done": dict(sorted(counts.items()))}


@dataclass(frozen=True)
class SubmissionCheck:
    """What came of the check of a submission: policy, origin and key as the file says, the kernel of linear algebra
    that so many navigations were driven again with, the first difference in words, if any, what else is to be known,
    and how long decisions took here, ms, median and 99th percentile; None where it did not decide.

    The scores are of what was driven again. Velocities do not tell whether X-ray was on when the recording says so:
    unless a policy decided again, there are no exposures and no missed events."""

    verdict: Verdict
    policy: str
    origin: str
    key: Mapping[str, Any]
    kernel: str
    navigations: int
    difference: str | None
    scores: Sequence[Mapping[str, Any]]
    remarks: tuple[str, ...]
    decision_ms: tuple[float, float] | None = None

    @property
    def confirmed(self) -> bool:
        """Whether the scores are what was driven again, to the bit."""
        return self.verdict in ("decided again", "replayed")


def kernels() -> str:
    """Return which kernels of linear algebra and of numpy's functions run here, as in `KERNELS`."""
    loaded = [each for each in threadpool_info() if each["user_api"] == "blas"]
    blas = {f"{each['internal_api']} {each.get('architecture', '')}".strip() for each in loaded}
    (exp,) = opt_func_info(func_name="^exp$", signature="float64")["exp"].values()
    return ", ".join([*sorted(blas), f"numpy {exp['current']}"])


def write_submission(
    path: Path,
    policy: str,
    terms: Terms,
    results: Mapping[str, Sequence[Mapping[str, Any]]],
    scores: Sequence[Mapping[str, Any]],
    *,
    drawn: str | None = None,
) -> None:
    """Write the submission file of a policy; `results` are those of `attempt`, in the order of each task's patients."""
    known = {each.name for each in fields(NavigationEntry)}
    submission = Submission(
        ladder=terms.version,
        key=key_of(terms, {name: len(done) for name, done in results.items()}),
        policy=policy,
        origin=POLICIES.origin(policy),
        versions=manifest(config=None)["versions"],
        core=_core.LEVEL,
        blas=kernels(),
        tasks={name: task_digest(find_task(name, version=terms.version)) for name in results},
        navigations={
            name: tuple(NavigationEntry(**{key: value for key, value in one.items() if key in known}) for one in done)
            for name, done in results.items()
        },
        scores=tuple(submitted(row) for row in scores),
        robot=terms.robot,
        world=terms.world,
        drawn=drawn,
        thinking_s=terms.thinking_s,
        decision_ms=decision_ms([one for done in results.values() for one in done]),
    )
    write_json(path, submission)


def read_submission(path: str | Path) -> Submission:
    """Read a submission file, whose scores are not checked; InputError where the file is none, or its tasks or seeds
    are not those of this ladder."""
    path = Path(path)
    submission = read_settings(path, Submission, remedy="give a submission.json of `endopilot ladder`")
    if set(submission.tasks) != set(submission.navigations):
        raise InputError(f"{path}: tasks and navigations name different tasks; give the file as it was written")
    counts = {name: len(entries) for name, entries in submission.navigations.items()}
    try:
        tasks = {name: submission.terms.task(name) for name in counts}
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    most = max(counts.values(), default=0)
    known = max((len(task.ladder.numbers) for task in tasks.values()), default=0)
    whole = all(1 <= counts[name] == min(most, len(task.ladder.numbers)) for name, task in tasks.items())
    if not counts or not whole:
        raise InputError(f"{path}: navigations: {counts}; each task needs the same first 1 to {known} patients")
    for name, entries in submission.navigations.items():
        if submission.tasks[name] != task_digest(find_task(name, version=submission.ladder)):
            raise InputError(
                f"{path}: task {name!r} of ladder {submission.ladder} is not the one here: its definition, a device "
                "or an anatomy is another; check it with the folder as it was, or with endopilot "
                f"{submission.versions.get('endopilot')}"
            )
        for place, entry in enumerate(entries):
            if entry.seed != (seed := navigation_seed(tasks[name], place)):
                raise InputError(f"{path}: task {name}, patient {place}: seed {entry.seed}; the ladder's is {seed}")
    own = key_of(submission.terms, counts)
    for name in dict.fromkeys([*own, *submission.key]):
        said, follows = (json_text(key.get(name), indented=False) for key in (submission.key, own))
        if said != follows:
            raise InputError(
                f"{path}: key.{name}: {said}; from all else follows {follows}: give the file as it was written, or "
                f"check it with endopilot {submission.versions.get('endopilot')}"
            )
    return submission


def check_submission(path: str | Path, *, policy: str = "") -> SubmissionCheck:
    """Drive all recordings of a submission file again, and compare every figure to the bit; nothing else is believed.

    They are driven with the file's kernel of linear algebra, one of `KERNELS`. A policy that is at hand also decides
    again: its exposures are counted then. Where it decides otherwise, the file fails, whatever version it names.
    Shipped policies are at hand; `policy` is MODULE:OBJECT of the file's, where you have it and trust it. InputError
    where the file is no submission of this ladder, or was made with a kernel that nobody can drive it again with.
    """
    submission = read_submission(path)
    kernel, at_hand = submission.blas or "none", submission.policy in (*POLICIES.shipped, policy)
    if kernel not in KERNELS:
        _, variables = next(iter(KERNELS.values()))
        raise InputError(
            f"{path}: blas: {kernel}; submissions are driven again with {' or with '.join(KERNELS)}: run the ladder "
            f"again with {' '.join(f'{name}={value!r}' for name, value in variables.items())}"
        )
    remark = f"this machine does not run {kernel}: nothing was driven again"
    found: dict[str, Any] = {"verdict": "not judged", "difference": None, "scores": (), "remarks": (remark,)}
    with _running(kernel) as (runs, pool), tempfile.TemporaryDirectory(prefix="endopilot-") as folder:
        if runs:
            found = _driven_again(submission, Path(folder), pool, at_hand)
    return SubmissionCheck(
        policy=submission.policy,
        origin=submission.origin,
        key=submission.key,
        kernel=kernel,
        navigations=sum(map(len, submission.navigations.values())),
        **found,
    )


@contextmanager
def _running(name: str) -> Iterator[tuple[bool, Workers | None]]:
    """Yield whether this machine runs kernels, and processes that do, unless this one does."""
    if name == kernels():
        yield True, None
        return
    level, variables = KERNELS[name]
    before = {each: os.environ.get(each) for each in variables}
    os.environ |= variables
    try:
        with Workers() as pool:
            runs = False
            if level in _core.supported_levels():
                with suppress(BrokenProcessPool):  # some libraries do not let their kernel be chosen
                    runs = pool.submit(kernels).result() == name
            yield runs, pool
    finally:
        for each, value in before.items():
            os.environ.pop(each)
            os.environ |= {} if value is None else {each: value}


def _driven_again(submission: Submission, folder: Path, pool: Workers | None, at_hand: bool) -> dict[str, Any]:
    """Return verdict, first difference, scores and remarks of `SubmissionCheck`."""
    terms, policy = submission.terms, submission.policy
    here = {**manifest(config=None)["versions"], "core": _core.LEVEL, "blas": kernels()}
    made = {**submission.versions, "core": submission.core, "blas": submission.blas}
    remarks = [f"made with {of} {made.get(of)}, checked with {now}" for of, now in here.items() if made.get(of) != now]
    tasks = sorted(map(terms.task, submission.navigations), key=lambda task: task.level)
    entries = {
        folder / task.name / f"{place:02d}.json": entry
        for task in tasks
        for place, entry in enumerate(submission.navigations[task.name])
    }
    for path, entry in entries.items():
        write_json(path, entry)
    work = partial(_repeat, terms=terms, policy=policy if at_hand else None)
    bad = each(f"Checking {policy}", list(entries), work, pool)
    again = {path: read_json(path) for path in entries if path not in bad}
    took_ms = decision_ms(list(again.values()))
    differing = [f"task {at.parent.name}, patient {int(at.stem)}: {bad[at]}" for at in entries if at in bad]
    rows = []
    if differing:
        differing[0] += f" ({len(differing)} of {len(entries)} navigations differ)"
    else:
        results = {task.name: [again[path] for path in entries if path.parent.name == task.name] for task in tasks}
        rows = score(tasks, results)
        pairs = zip_longest(submission.scores, rows, fillvalue={})
        said = [(row.get("task") or given.get("task"), _difference(given, submitted(row))) for given, row in pairs]
        differing = [f"scores, {task}: {remark}" for task, remark in said if remark]
    if not at_hand:
        uncounted = ("exposures", "missed_events")
        rows = [{name: value for name, value in row.items() if name not in uncounted} for row in rows]
        remarks.append("exposures are not counted: the policy is not at hand")
    return {
        "verdict": "failed" if differing else "decided again" if at_hand else "replayed",
        "difference": differing[0] if differing else None,
        "scores": () if differing else rows,
        "remarks": tuple(remarks),
        "decision_ms": took_ms,
    }


def recorded_navigation(path: Path, name: str | None, place: int) -> tuple[Task, int, Recording]:
    """Return the task, the patient's place in its list, and the recording of one navigation in a submission.json, or in
    TASK/NUMBER.json of a ladder's folder, which tells task and place by itself; InputError where there is none.
    """
    content = read_json(path)
    if isinstance(content, dict) and "navigations" in content:
        if name is None or name not in content["navigations"]:
            raise InputError(f"task: {name!r}; {path} has {', '.join(content['navigations'])}")
        entries = content["navigations"][name]
        if not 0 <= place < len(entries):
            raise InputError(f"world: {place}; {path} has patients 0 to {len(entries) - 1} of this task")
        entry, terms = entries[place], read_submission(path).terms
    elif isinstance(content, dict) and "recording" in content and path.stem.isdecimal():
        name, place, entry, terms = path.parent.name, int(path.stem), content, Terms.of(content)
    else:
        raise InputError(f"{path}: is no file of the ladder; give a submission.json or TASK/NUMBER.json")
    task = terms.task(name)
    return task, place, Recording.unpacked(entry["recording"], 2 if task.catheter else 1, terms)


def _repeat(path: Path, *, terms: Terms, policy: str | None) -> None:
    """Drive the recording of the entry in a file again, and put the figures in its place; InputError where they are
    others, or a policy decides otherwise."""
    task, place, entry = terms.task(path.parent.name), int(path.stem), NavigationEntry(**read_json(path))
    navigation, seed = task.ladder_navigation(place), navigation_seed(task, place)
    recording = Recording.unpacked(vars(entry.recording), len(navigation.devices), terms)
    figures = {"patient": navigation.anatomy.name} | repeat(recording, navigation, seed=seed)
    if difference := _difference(entry.figures(), figures):
        raise InputError(difference)
    if policy is not None:
        done = attempt(policy, navigation, seed=seed, terms=terms)
        if done["sha256"] != figures["sha256"]:
            raise InputError(f"{policy} decides otherwise")
        figures["decision_s"] = done["decision_s"]
    write_json(path, figures)


def _difference(given: Mapping[str, Any], again: Mapping[str, Any]) -> str | None:
    """Return the first value that differs, in words; as text, so that a NaN equals a NaN."""
    for name in [*again, *given]:
        before, now = (json_text(values.get(name, "absent")) for values in (given, again))
        if before != now and name == "sha256":
            return "decisions or course are not those that the file's hash was made of"
        if before != now:
            return f"{name} is {before} in the file and {now} when driven again"
    return None
