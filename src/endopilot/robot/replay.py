"""A log replayed: its commands drive a simulated wire, and the tip that was seen is compared with the simulated one.

Nobody logs how deep the wire lies when an episode begins, or to which side its tip is bent. Both are taken from what
was seen in the given first part of the episode: of worlds whose wires are turned by equal angles, the one whose tip
comes nearest to the real one there. What follows is predicted from the commands alone: kinematics lead the tip along
the branch that the core takes, and the tip is expected beside it by what tips before were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from endopilot.anatomy.projection import TipProjector
from endopilot.anatomy.tree import tangents
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.lines import places_on
from endopilot.robot.candidates import LEAST_EPISODES, UNKNOWN_SHARE, Candidates
from endopilot.robot.kinematics import Tracks, evenly, filtered, led
from endopilot.robot.log import Courses, RobotLog
from endopilot.settings import OpenShare, Within, public, settings
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.simulation.robots import in_grip
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy

LEAST_TIPS = 20
"""Tips that an episode must have to be replayed: half of them say where the wire lies."""
_PERIOD_S = 0.05
_LEAD_S = 2.0
"""A simulation begins so long before the first tip was seen, or with the first command, s."""
_KEEPS_RAD, _TELLS_MM = 0.2, 0.2
"""Rotation that a wire loses on its drive between episodes, and by how much farther tips are in a world 1/e as likely:
.71 of the public logs' episodes end in the real branch, .69 to .72 with .1 to .2 rad and .1 to .3 mm, .62 without."""
_FADES = 0.08
"""Share of what is given over which a tip's weight falls by 1/e, when a world is chosen: of the public logs' passages
.76 take the real branch with .03 to .1, .74 with .15, .64 with 1."""
_BESIDE = (0.2, 1.5, 0.3, 10.0, 0.1)
"""How far tips are beside where they are led, mm: deviation of a map of the vessel, and length over which it is alike;
deviation of what an episode adds, and travel over which 1/e of it is left; noise. Likeliest for six public logs; in the
plane .44 mm of the core's error become .28 there, and the best of core and kinematics errs by .37."""
_OWN, _EARLIER = 50, 200
"""Tips that tell it at most, of the episode and of the log's episodes before, evenly chosen for time."""
_TOGETHER = 8
"""Episodes that are simulated side by side, for as long as the longest of them takes."""
_TRAVEL_MM = 1000.0
"""A drive that goes farther in an episode than this and the vessel's length is logged in another unit, mm."""
FAR_MM = 2.0
"""No tip counts as farther from the real one than this, mm, when a world is chosen: one in a wrong branch is wrong."""


@settings
class ReplayConfig:
    """How a log is replayed."""

    given: OpenShare = 0.5
    """Share of each episode's tips that say where the wire lies; the rest is predicted."""
    rotations: Annotated[int, Within(1, 360)] = 12
    """Rotations that the wire may begin with, at equal angles."""


@dataclass(frozen=True, eq=False)
class EpisodeReplay:
    """One episode, seen and simulated: when the tip was seen, by the log's clock, s, where it was and where the
    simulated one was, LPS mm, with their branches. Tips that are `given` say where the wire lies, others are predicted.

    Attributes:
        predicted: where the tip is expected, LPS mm: beside where kinematics lead it in the simulated tip's branch, or
            beside the simulated tip, by what tips before were; as simulated while given.
        abscissa: Δtip of both, seen and simulated, mm.
        driven: Δtip without the vessel: what lag, gain and play make of the commands, from the last given tip, mm.
        in_view: the difference of the predicted tip from the real one, as the camera sees it, mm.
        core_mm: distance of the simulated tip from the real one, likewise.
        along: unit vector along the vessel at the real tip.
        force: of the drive, N, as the log has it and simulated, at each of its readings after the first tip.
        rotation_rad: φ that the simulated wire began with.
        rotation_known_rad: rotations no farther from it than this are as good, as what was given tells; NaN where it
            does not tell.
    """

    number: int
    time_s: Float[np.ndarray, "tips"]
    given: Bool[np.ndarray, "tips"]
    seen: Float[np.ndarray, "tips 3"]
    simulated: Float[np.ndarray, "tips 3"]
    predicted: Float[np.ndarray, "tips 3"]
    abscissa: Float[np.ndarray, "tips 2"]
    driven: Float[np.ndarray, "tips"]
    in_view: Float[np.ndarray, "tips 3"]
    core_mm: Float[np.ndarray, "tips"]
    along: Float[np.ndarray, "tips 3"]
    branch: Float[np.ndarray, "tips 2"]
    force: Float[np.ndarray, "readings 2"]
    rotation_rad: float
    rotation_known_rad: float

    @property
    def errors(self) -> dict[str, float]:
        """Median errors of what was predicted, mm: of Δtip, across the vessel, and in the camera's view."""
        rest = ~self.given
        along = (self.in_view * self.along).sum(axis=1, keepdims=True) * self.along
        sizes = (
            np.abs(np.diff(self.abscissa, axis=1)[:, 0]),
            np.linalg.norm(self.in_view - along, axis=1),
            np.linalg.norm(self.in_view, axis=1),
        )
        return {
            name: float(np.median(size[rest])) for name, size in zip(("along", "across", "in_view"), sizes, strict=True)
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Prepared(Tracks):
    """Episodes and what was seen in them, with the vessel."""

    logs: list[RobotLog]
    anatomy: Anatomy
    branch: Float[np.ndarray, "episodes tips"]
    given: Bool[np.ndarray, "episodes tips"]


def usable_episodes(logs: Sequence[RobotLog], anatomy: Anatomy) -> list[RobotLog]:
    """Return the episodes that can be replayed, with tips in space, from the last command before the first tip on:
    nobody saw whether the wire followed what a drive did before. InputError where there is none."""
    found = [episode for log in logs for episode in log.in_vessel(anatomy.tree).episodes()]
    found = [each.from_first_tip() for each in found if each.seen.sum() >= LEAST_TIPS]
    found = [each for each in found if each.commanded.sum() > 1]
    if not found:
        names = ", ".join(log.name for log in logs)
        raise InputError(f"{names}: no episode shows the tip {LEAST_TIPS} times; log longer ones, or mark fewer resets")
    return found


@public
def replay_log(
    logs: Sequence[RobotLog],
    anatomy: Anatomy,
    device: Stack,
    *,
    robot: RobotConfig,
    config: ReplayConfig | None = None,
) -> list[EpisodeReplay]:
    """Replay logs: what a robot, by its latency, gains and plays, makes of their commands with a wire in a vessel;
    InputError where no episode shows the tip often enough."""
    config = config or ReplayConfig()
    prepared = prepare(usable_episodes(logs, anatomy), anatomy, config.given, robot)
    return replay_prepared(prepared, device, robot, config)


def prepare(logs: list[RobotLog], anatomy: Anatomy, given: float, robot: RobotConfig) -> Prepared:
    """Project what was seen in episodes onto a vessel, once for many replays; InputError where a drive goes too far: in
    another unit."""
    longest_mm = float(anatomy.tree.longest_path().abscissa[-1])
    for log in logs:
        if (travel := float(np.ptp(log.command[log.commanded, 0, 0]))) > longest_mm + _TRAVEL_MM:
            raise InputError(
                f"{log.name}: translation_mm goes over {travel:.0f} mm in episode {log.episode[0]}, and {anatomy.name} "
                f"is {longest_mm:.0f} mm long; give mm, and times in s"
            )
    courses, project = Courses.of(logs, robot.wire), TipProjector(anatomy.tree, anatomy.insertion)
    abscissa, branch = np.full(courses.seen.shape, np.nan), np.full(courses.seen.shape, -1.0)
    share = np.zeros(courses.seen.shape, dtype=bool)
    for k, log in enumerate(logs):
        count, tip = int(log.seen.sum()), project(log.tip[log.seen])
        abscissa[k, :count], branch[k, :count] = tip.abscissa, tip.branch
        share[k, : max(1, round(given * count))] = True
    return Prepared(courses, abscissa, logs=logs, anatomy=anatomy, branch=branch, given=share & courses.seen)


def replay_prepared(
    of: Prepared,
    device: Stack,
    robot: RobotConfig,
    config: ReplayConfig,
) -> list[EpisodeReplay]:
    """Replay episodes that are prepared, as `replay_log` does."""
    device, simulator = in_grip(device, robot, PRESETS["fast"])
    known = replace(of, abscissa=np.where(of.given, of.abscissa, np.nan))
    driven, seen, start, noise = led(known, robot)
    times, course = _proximal(of, robot, start)
    angles = np.tile(2 * np.pi * np.arange(config.rotations) / config.rotations, (len(of.logs), 1))
    tried = _simulated(of, device, times, course, seen.offset, angles, simulator)
    first = np.argmax(_likely(of, tried, angles[0]), axis=1)
    # Once more where the wire lay deeper, or less deep, than without the vessel.
    apart = known.abscissa.copy()
    apart[of.courses.seen] -= np.concatenate([each.abscissa[k] for each, k in zip(tried, first, strict=True)])
    depth = seen.offset + filtered(apart, known.travel(robot.latency_s), noise).offset
    turned = np.take_along_axis(angles, first[:, None], axis=1)
    best = _simulated(of, device, times, course, depth, turned, simulator)
    expected = _expected(of, best, driven)
    rotations = [(turn, _known_rotation(_far_from(of, tried[k], k, of.given))) for k, turn in enumerate(turned[:, 0])]
    ends = times[:, 1:]
    return [_episode(of, k, best[k], expected[k], driven[k], ends[k], each) for k, each in enumerate(rotations)]


def _expected(
    of: Prepared, best: list[_Tried], driven: Float[np.ndarray, "episodes tips"]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return where tips are expected: beside where kinematics lead them in the core's branch, or beside the core's tip,
    whichever was nearer to tips before.

    By how much is a Gaussian process (Rasmussen & Williams 2006, chapter 2): a map of the vessel, which the log's
    episodes before tell too, and what an episode adds, which is forgotten as the wire slides.
    """
    found, name, nothing = [], "", np.empty((0, 8))
    before = [nothing, nothing]
    for k, log in enumerate(of.logs):
        if log.name != name:
            before, name = [nothing, nothing], log.name
        count = int(of.courses.seen[k].sum())
        given, led_mm, branch = of.given[k, :count], driven[k, :count], of.branch[k, :count]
        since = [np.cumsum(np.abs(np.diff(led_mm, prepend=led_mm[0]))), np.full(count, k)]
        core, taken = best[k].tip[0], best[k].branch[0]
        lines = _on_lines(of, led_mm, branch), _on_lines(of, led_mm, np.where(given, branch, taken))
        tried = []
        for j, (real, led_to) in enumerate((lines, (core, core))):
            rows = np.column_stack([real, *since, -_in_view(log, real)])
            own, earlier = rows[given], before[j]
            known = np.concatenate([own[evenly(len(own), _OWN)], earlier[evenly(len(earlier), _EARLIER)]])
            before[j] = np.concatenate([earlier, rows[(branch == taken) | (j == 0)]])
            weights = np.linalg.solve(_alike(known, known) + _BESIDE[-1] ** 2 * np.eye(len(known)), known[:, 5:])
            beside = _alike(np.column_stack([led_to, *since]), known) @ weights
            tried.append((np.linalg.norm(known[:, 5:], axis=1).mean(), led_to + beside))
        found.append(min(tried, key=lambda one: one[0])[1])
    return found


def _alike(tips: Float[np.ndarray, "n columns"], known: Float[np.ndarray, "m more"]) -> Float[np.ndarray, "n m"]:
    """Return the covariance, mm², of what tips are beside; columns are place, travel, mm, and episode."""
    map_mm, length_mm, episode_mm, travel_mm, _ = _BESIDE
    near = map_mm**2 * np.exp(-cdist(tips[:, :3], known[:, :3], "sqeuclidean") / (2 * length_mm**2))
    since = np.abs(tips[:, None, 3] - known[:, 3]) / travel_mm
    return near + episode_mm**2 * (tips[:, None, 4] == known[:, 4]) * np.exp(-since)


def _on_lines(
    of: Prepared, abscissa: Float[np.ndarray, "tips"], branch: Float[np.ndarray, "tips"]
) -> Float[np.ndarray, "tips 3"]:
    """Return the points at abscissas on the lines to some branches."""
    found = np.empty((len(branch), 3))
    for one in np.unique(branch):
        line, here = of.anatomy.tree.path(int(one)), branch == one
        found[here] = places_on(line.points, line.abscissa, abscissa[here])
    return found


def _proximal(
    of: Prepared, robot: RobotConfig, start: Float[np.ndarray, "episodes"]
) -> tuple[Float[np.ndarray, "episodes times"], Float[np.ndarray, "episodes times 2"]]:
    """Return equal times of each episode, and where the drive then has the wire, mm and rad, from its first place."""
    drive, seen_s = robot.wire, of.courses.seen_s
    begin = np.maximum(seen_s[:, 0] - _LEAD_S, 0.0)
    count = int(np.ceil((seen_s.max(axis=1) - begin).max() / _PERIOD_S)) + 1
    times, course = begin[:, None] + _PERIOD_S * np.arange(count + 1), []
    axes = ((drive.gain_translation, drive.play_mm, start), (drive.gain_rotation, drive.play_rad, 0.0))
    for axis, (gain, play, begun) in enumerate(axes):
        of_one = {"latency_s": robot.latency_s, "gain": gain, "play": play}
        constants = {name: np.array([value]) for name, value in of_one.items()}
        course.append(of.courses.followed(axis, at_s=times, start=begun, **constants)[0])
    return times, np.stack(course, axis=-1)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Worlds of one episode: their tips where the real one was seen, and their drives' force at ends of periods, N."""

    tip: Float[np.ndarray, "worlds tips 3"]
    abscissa: Float[np.ndarray, "worlds tips"]
    branch: Int[np.ndarray, "worlds tips"]
    force: Float[np.ndarray, "worlds periods"]


def _simulated(
    of: Prepared,
    device: Stack,
    times: Float[np.ndarray, "episodes times"],
    course: Float[np.ndarray, "episodes times 2"],
    depth: Float[np.ndarray, "episodes"],
    angles: Float[np.ndarray, "episodes worlds"],
    simulator: SimulatorConfig,
) -> list[_Tried]:
    """Simulate worlds that begin at some depth, with some rotations; short episodes together, and long ones."""
    place = course.copy()
    place[..., 0] = np.maximum(place[..., 0] + depth[:, None], 0.0)
    fastest = device.fastest[0]
    control = np.clip(np.diff(place, axis=1) / _PERIOD_S, -fastest, fastest)
    samples, tried = np.ceil((of.courses.seen_s.max(axis=1) - times[:, 0]) / _PERIOD_S - 1e-9).astype(int), {}
    for some in np.array_split(np.argsort(samples), max(1, len(samples) // _TOGETHER)):
        last, worlds = int(samples[some].max()), angles[some].size
        rows = np.arange(worlds).reshape(len(some), -1)
        initial = np.repeat(place[some, None, 0], angles.shape[1], axis=1)
        initial[..., 1] += angles[some]
        begun, turned = (initial[..., axis].reshape(-1, 1) for axis in range(2))
        driven = np.repeat(control[some, :last], angles.shape[1], axis=0)[:, :, None]
        pushed = begun + np.maximum(driven[..., 0] * _PERIOD_S, 0.0).sum(axis=1)  # none of the pulls may be made
        deepest = float(max(place[..., 0].max(), pushed.max()))
        made = Simulator(of.anatomy, device, worlds=worlds, config=simulator, reach_mm=deepest)
        made.reset(inserted_length=begun, rotation=turned)
        moved = made.run(driven, period_s=_PERIOD_S)
        for k, own in zip(some.tolist(), rows, strict=True):
            ends, seen_s = times[k, 1 : last + 1], of.courses.seen_s[k, of.courses.seen[k]]
            places = np.dstack([moved.tip_position[own, :, 0], moved.tip.abscissa[own, :, 0]])
            at_tips = np.stack([places_on(each, ends, seen_s) for each in places])
            branch = moved.tip.branch[own, :, 0][:, np.clip(np.searchsorted(ends, seen_s), 0, last - 1)]
            tried[k] = _Tried(at_tips[..., :3], at_tips[..., 3], branch, moved.drive_force[own, :, 0])
    return [tried[k] for k in range(len(samples))]


def _far_from(
    of: Prepared, tried: _Tried, k: int, used: Bool[np.ndarray, "episodes tips"]
) -> Float[np.ndarray, "worlds used"]:
    """Return how far tips of an episode are from the real ones that are used, at most `FAR_MM`, mm."""
    far = np.linalg.norm(_in_view(of.logs[k], tried.tip), axis=-1)
    return np.minimum(far[:, used[k, of.courses.seen[k]]], FAR_MM)


def _likely(
    of: Prepared, tried: list[_Tried], angles: Float[np.ndarray, "worlds"]
) -> Float[np.ndarray, "episodes worlds"]:
    """Return how likely the worlds of each episode are: by how far its given tips are from the real ones, of which the
    last count most, for where the wire lies when the prediction begins matters, and by how the log's episodes before
    ended. A wire that nobody clamped anew keeps its rotation on the drive, as the rotations so far tell."""
    found, count, before = np.empty((len(of.logs), len(angles))), len(angles), ""
    known, trust = np.empty(count), 0.0
    for k, log in enumerate(of.logs):
        if log.name != before:  # rotations on the drive, and whether they are kept
            known, trust, before = np.full(count, 1 / count), 0.5, log.name
        on_drive = angles[:, None] - log.command[log.commanded, 0, 1][0] - angles
        near = np.exp((np.cos(on_drive) - 1) / _KEEPS_RAD**2)
        near /= near.sum(axis=0)
        foretold = trust * near @ known + (1 - trust) / count
        far = _far_from(of, tried[k], k, of.given)
        cost = np.average(far, axis=1, weights=np.exp(-np.arange(far.shape[1])[::-1] / far.shape[1] / _FADES))
        found[k] = foretold * np.exp((cost.min() - cost) / _TELLS_MM)
        whole = _far_from(of, tried[k], k, of.courses.seen).mean(axis=1)
        likely = np.exp((whole.min() - whole) / _TELLS_MM)
        trust = float(np.clip(trust * (near @ known @ likely) / (foretold @ likely), 0.05, 0.95))
        known = near.T @ (foretold * likely)
        known /= known.sum()
    return found / found.sum(axis=1, keepdims=True)


def _known_rotation(far: Float[np.ndarray, "worlds given"]) -> float:
    """Return half the arc of the rotations that are as good as the best, rad, by how far the tips of worlds, which
    began at equal angles, are from the real ones, mm; NaN where that is most of a turn."""
    parts = [part.sum(axis=1) for part in np.array_split(far, LEAST_EPISODES, axis=1)]
    good = Candidates({}, np.empty((len(far), 0)), np.stack(parts, axis=1)).as_good
    gaps = np.diff(np.flatnonzero(np.tile(good, 2))[: good.sum() + 1])
    arc = 1 - (gaps.max() - 1) / len(far)  # of a turn, with half a step to either side
    return np.pi * arc if arc < UNKNOWN_SHARE else np.nan


def _in_view(log: RobotLog, tip: Float[np.ndarray, "*worlds tips 3"]) -> Float[np.ndarray, "*worlds tips 3"]:
    """Return the difference of simulated tips from those seen, without what a camera does not see of it, mm."""
    apart = tip - log.tip[log.seen]
    if log.camera is None:
        return apart
    _, ray = log.camera.rays(log.pixel[log.seen])
    return apart - (apart * ray).sum(axis=-1, keepdims=True) * ray


def _episode(
    of: Prepared,
    k: int,
    best: _Tried,
    expected: Float[np.ndarray, "seen 3"],
    driven: Float[np.ndarray, "tips"],
    ends: Float[np.ndarray, "times"],
    rotation: tuple[float, float],
) -> EpisodeReplay:
    log, count = of.logs[k], int(of.courses.seen[k].sum())
    line = of.anatomy.tree.path(int(of.branch[k, count - 1]))
    nearest = np.clip(np.searchsorted(line.abscissa, of.abscissa[k, :count]), 0, len(line.points) - 1)
    measured = np.isfinite(log.load[:, 0, 0]) & (log.time_s >= log.time_s[log.seen][0])
    tip, given, force = best.tip[0], of.given[k, :count], best.force[0]
    predicted = np.where(given[:, None], tip, expected)
    pushed = np.interp(log.time_s[measured] - log.time_s[0], ends[: len(force)], force)
    return EpisodeReplay(
        number=int(log.episode[0]),
        time_s=log.time_s[log.seen],
        given=given,
        seen=log.tip[log.seen],
        simulated=tip,
        predicted=predicted,
        abscissa=np.column_stack([of.abscissa[k, :count], best.abscissa[0]]),
        driven=driven[:count],
        in_view=_in_view(log, predicted),
        core_mm=np.linalg.norm(_in_view(log, tip), axis=1),
        along=tangents(line.points)[nearest],
        branch=np.column_stack([of.branch[k, :count], best.branch[0]]),
        force=np.column_stack([log.load[measured, 0, 0], pushed]),
        rotation_rad=float(rotation[0]),
        rotation_known_rad=rotation[1],
    )


def summary(found: Sequence[EpisodeReplay]) -> dict[str, float | int | None]:
    """Return medians over episodes of their errors, mm, and how often the real branch was taken."""
    errors = [each.errors for each in found]
    figures: dict[str, float | int | None] = {"episodes": len(found)}
    for name in ("along", "across", "in_view"):
        figures[f"error_{name}_mm"] = round(float(np.median([each[name] for each in errors])), 3)
    drive_alone = [np.median(np.abs(each.abscissa[:, 0] - each.driven)[~each.given]) for each in found]
    figures["error_along_of_the_drive_alone_mm"] = round(float(np.median(drive_alone)), 3)
    ends = [each.branch[-1, 0] == each.branch[-1, 1] for each in found]
    return figures | {"real_branch_share": round(float(np.mean(ends)), 3)}
