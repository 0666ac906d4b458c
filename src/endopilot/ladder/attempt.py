"""One navigation of the ladder: `attempt` lets a policy drive it, `Apart` in a process of its own, and `repeat` drives
its recording again."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import multiprocessing
import zlib
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import AdviserConfig
from endopilot.belief.events import count_events
from endopilot.control.agent import AgentPolicy
from endopilot.errors import InputError
from endopilot.ladder.terms import Terms
from endopilot.navigation.loop import NavigationLoop
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import Decision, Observation
from endopilot.navigation.record import NavigationRecord
from endopilot.plugins import described
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import DRAWN, Task
from endopilot.types import TipProjection


class Apart:
    """A policy that cannot reach the simulated world: it learns what a `NavigationLoop` hands out, and has to ask.

    Its answers come as text, so that they are decisions whatever it sends. It has a seed of its own: that of the
    navigation would tell it the errors of detection. It still has the files and the network of whoever runs it; a
    container takes these away.
    """

    def __init__(self, policy: str) -> None:
        """Start the process, which makes the policy of this name."""
        spawned = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawned.Pipe()
        self._process, self._name = spawned.Process(target=_serve, args=(policy, theirs), daemon=True), policy
        self._process.start()
        theirs.close()

    def __enter__(self) -> Apart:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()

    def start(self, navigation: Navigation, seed: int) -> None:
        """Let it prepare for a navigation."""
        self._ask("start", navigation, int(hashlib.sha256(f"policy {seed}".encode()).hexdigest()[:16], 16))

    def decide(self, observation: Observation) -> Decision:
        """Return what it decides, or raise `InputError` where it fails or decides something else."""
        try:
            said = self._ask("decide", observation)
            devices = tuple((float(v), float(w)) for v, w in said["devices"])
            return Decision(devices, expose=bool(said["expose"]), gives_up=str(said["gives_up"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"policy: {self._name!r} decided no velocities ({error}); return a Decision") from error

    def _ask(self, method: str, *given: Any) -> Any:
        try:
            self._pipe.send((method, given))
            said = json.loads(self._pipe.recv_bytes())
        except (EOFError, OSError) as error:
            raise InputError(f"policy: the process of {self._name!r} has ended; mend it") from error
        if "error" in said:
            raise InputError(str(said["error"]))
        return said


def _serve(name: str, pipe: Connection) -> None:
    """Make the policy and answer until the process ends."""
    policy = None
    while True:
        method, given = pipe.recv()
        try:
            policy = policy or make_policy(name)
            said = getattr(policy, method)(*given)
            answer = vars(said) if isinstance(said, Decision) else {}
            text = json.dumps(answer, default=float)
        except Exception as error:  # whatever it is, the other process is to name it
            text = json.dumps({"error": str(error) if isinstance(error, InputError) else described(error)})
        pipe.send_bytes(text.encode())


_MOST_BYTES = 1 << 20
"""No array of a recording is larger, bytes; one that claims to be is cut off."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What was decided during a navigation, in full precision: enough to drive it again on its terms. At each decision
    the velocities of each device within the robot's limits (mm/s, rad/s), whether X-ray was on, and, of the agent, Δtip
    as it believed it, mm."""

    control: Float[np.ndarray, "decisions devices 2"]
    exposed: Bool[np.ndarray, "decisions"]
    believed_mm: Float[np.ndarray, "decisions"] | None
    gave_up: bool = False
    terms: Terms = field(default_factory=Terms)

    def packed(self) -> dict[str, Any]:
        """Return the recording as text: little-endian arrays, compressed by zlib, in base64."""
        believed = self.believed_mm
        return {
            "control": _pack(self.control, "<f8"),
            "exposed": _pack(self.exposed, "|u1"),
            "believed_mm": None if believed is None else _pack(believed, "<f8"),
            "gave_up": self.gave_up,
        }

    @staticmethod
    def unpacked(text: dict[str, Any], devices: int = 1, terms: Terms | None = None) -> Recording:
        """Return the recording that `packed` made a text of, or raise `InputError` where that is none."""
        control, exposed = _unpack(text, "control", "<f8"), _unpack(text, "exposed", "|u1") != 0
        believed = None if text["believed_mm"] is None else _unpack(text, "believed_mm", "<f8")
        count, sizes = len(exposed), {"control": len(control) / (2 * devices)}
        for name, size in (sizes if believed is None else sizes | {"believed_mm": len(believed)}).items():
            if size != count or count == 0:
                raise InputError(f"{name}: {size:g} decisions, exposed: {count}; each must have one value a decision")
        if not exposed[0]:
            raise InputError("exposed: X-ray is off at the first decision, where it is always on")
        decided, gave_up = control.reshape(count, devices, 2), bool(text.get("gave_up", False))
        return Recording(decided, exposed, believed, gave_up, terms or Terms())


def navigation_seed(task: Task, place: int) -> int:
    """Return the seed of the navigation in the patient at some place of a task's list."""
    return place + (task.ladder.seed if task.ladder.seed >= DRAWN else 100 * task.level)


def attempt(policy: str, navigation: Navigation, *, seed: int, terms: Terms | None = None) -> dict[str, Any]:
    """Let a policy drive a navigation, and return its figures, its course and its recording.

    `decision_s` is the wall time that each decision took, s, and `planning_s`, where the policy searches, the time
    that its searches took. They are no figures: they differ from run to run. On terms whose patients are drawn, the
    policy runs in a process of its own (`Apart`). A policy that is none, or a wire that does not fit, is an InputError.
    """
    terms = terms or Terms()
    with Apart(policy) if terms.request else nullcontext(make_policy(policy)) as driver:
        loop = NavigationLoop(navigation, driver, config=terms.loop, seed=seed, world=terms.reality)
        record = loop.run()
    result: dict[str, Any] = {"seed": seed, "decision_s": np.round(loop.decision_s, 5).tolist()}
    result |= scored(navigation, record, tells=isinstance(driver, AgentPolicy))
    planning_s = getattr(driver, "planning_s", None)
    return result if planning_s is None else result | {"planning_s": round(planning_s, 2)}


def scored(navigation: Navigation, record: NavigationRecord, *, tells: bool = False) -> dict[str, Any]:
    """Return the figures of a navigation, its course and its recording; if who drove `tells` a belief, also events."""
    believed = record.believed[:-1, 0] if tells and record.believed is not None else None
    recording = Recording(record.control[:-1], record.exposed[:-1], believed, record.reason == "gave up")
    course = {
        "time_s": record.time_s.tolist(),
        "tip_position": record.tip_position[:, 0].round(3).tolist(),
        "exposed": record.exposed.tolist(),
    }
    return _figures(navigation, record, recording) | {"course": course, "recording": recording.packed()}


def repeat(recording: Recording, navigation: Navigation, *, seed: int) -> dict[str, Any]:
    """Drive the recorded velocities through the same robot and simulator, and return the figures, as `attempt` did;
    InputError where the recording is longer or shorter than the navigation, or holds what the drives do not do."""
    record = begun(recording, navigation, seed=seed).run()
    given, needed = len(recording.control), len(record.control) - 1
    if given != needed:
        raise InputError(f"control: holds {given} decisions, and the navigation ends after {needed}")
    if beyond := np.flatnonzero((recording.control != record.control[:-1]).any(axis=(1, 2))).tolist():
        raise InputError(f"control: decision {beyond[0]} is beyond the drives' limits, within which policies are kept")
    return _figures(navigation, record, recording)


def begun(recording: Recording, navigation: Navigation, *, seed: int) -> NavigationLoop:
    """Return the loop that drives a navigation as it was recorded, to the bit; too short a recording is refused."""
    terms = recording.terms
    return NavigationLoop(navigation, Repeated(recording), config=terms.loop, seed=seed, world=terms.reality)


class Repeated:
    """A policy that decides what was recorded."""

    def __init__(self, recording: Recording) -> None:
        devices = [tuple((v, w) for v, w in each) for each in recording.control.tolist()]
        self._decisions = list(map(Decision, devices, [*recording.exposed[1:].tolist(), False]))
        if recording.gave_up:
            self._decisions[-1] = replace(self._decisions[-1], gives_up="as recorded")
        self._at = 0

    def start(self, navigation: Navigation, seed: int) -> None:
        """Begin at the first decision."""
        self._at = 0

    def decide(self, observation: Observation) -> Decision:
        """Return the next decision, or raise `InputError` where there is none."""
        if self._at == len(self._decisions):
            raise InputError(f"control: holds {self._at} decisions, and the navigation goes on")
        self._at += 1
        return self._decisions[self._at - 1]


def _figures(navigation: Navigation, record: NavigationRecord, recording: Recording) -> dict[str, Any]:
    """Return what a navigation is scored by, and the hash of all that was recorded of it and of how it went."""
    length_mm = navigation.target.abscissa - float(record.tip.abscissa[0, 0])
    scored = {
        "success": record.success,
        "safe": record.safe,
        "reason": record.reason,
        "seconds": record.seconds,
        "path_ratio": record.path_mm / length_mm,
        "peak_force_n": record.peak_force_n,
        "exposures": record.exposures,
    }
    if navigation.target.near_mm is not None:
        away = record.tip_position[:, navigation.arriving] - navigation.target.position(navigation.anatomy)
        scored["near"] = bool(np.linalg.norm(away, axis=-1).min() <= navigation.target.near_mm)
    if recording.believed_mm is not None:
        radius = navigation.device.tip_radius_mm
        scored["events"] = list(navigation_events(record.tip[:, 0], record.exposed, recording.believed_mm, radius))
    digest = hashlib.sha256(f"{len(record.time_s)}".encode())
    inserted, turned = record.inserted_length, record.rotation
    course = (inserted[:, 0], turned[:, 0], record.tip_position[:, 0], record.contact_force_max)
    course += (inserted[:, 1:], turned[:, 1:])
    for array in (recording.control, recording.exposed, recording.believed_mm, record.exposed, *course):
        if array is not None:
            digest.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return scored | {"sha256": digest.hexdigest()}


def navigation_events(
    tip: TipProjection,
    exposed: Bool[np.ndarray, "samples"],
    believed_mm: Float[np.ndarray, "decisions"],
    wire_radius_mm: float,
) -> tuple[int, int]:
    """Return how many events a navigation had by version 2 of the ladder, and how many X-ray did not show.

    `tip` is as it truly was at the start and after each decision period, `believed_mm` Δtip as the policy believed it.
    """
    count, advice = len(believed_mm), AdviserConfig()
    at_wall = safety_ratio(tip.offset, tip.radius, wire_radius_mm)[:count] >= advice.wall_ratio
    errs = np.abs(believed_mm - tip.abscissa[:count]) >= advice.abscissa_mm
    found = [count_events(state, exposed[:count], before=True) for state in (at_wall, errs)]
    return sum(each.happened for each in found), sum(each.missed for each in found)


def _pack(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(zlib.compress(values.astype(kind).tobytes(), 9)).decode("ascii")


def _unpack(text: dict[str, str | None], name: str, kind: str) -> np.ndarray:
    try:
        packed = base64.b64decode(text[name] or "", validate=True)
        values = np.frombuffer(zlib.decompressobj().decompress(packed, _MOST_BYTES), kind)
    except (binascii.Error, zlib.error, ValueError) as error:
        raise InputError(f"{name}: no recorded array ({error})") from error
    if not np.isfinite(values).all():
        raise InputError(f"{name}: holds what is no finite number")
    return values
