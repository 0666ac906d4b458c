"""What logs teach beyond the simulator: by how much a real tip is beside where drive and rod core have it, `learn`.

Kinematics lead the tip along the branch that the core takes (`replay`). What the real tip is off by, along the vessel
and to its side, is on each axis a Gaussian process (Rasmussen & Williams 2006, chapters 2 and 5): a map of the vessel,
in part the same in all sessions and in part each session's own, since another wire drives there or another camera
looks; what an episode adds, which is forgotten as the wire slides and turns; and noise. Tips of other sessions, of the
same log's episodes before, and the given ones condition it. Its scales are the likeliest for the logs. Whether the
core's branch is the real one, and whether the tip jumps in a step, are logistic regressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from endopilot.errors import InputError
from endopilot.files import regular, writing
from endopilot.robot.kinematics import earns, evenly
from endopilot.robot.replay import EpisodeReplay, Prepared
from endopilot.types import VesselTree

JUMP_MM = 0.57
"""A tip jumps that moves by so much more, or otherwise, than its drive in one step: six pixels of the public logs."""
_ALONG_MM = 1.0
"""Length over which the direction of a vessel is taken, mm: its line is drawn to a tenth of that."""
_FIRST = np.array([0.2, 1.5, 0.6, 0.3, 10.0, 2.0, 0.1])
_RANGES = np.array([[0.01, 2], [0.5, 20], [1e-3, 1], [0.01, 2], [0.5, 100], [0.1, 100], [0.02, 1]])
"""Where the search for `LearnedTip.scales` begins, those of six public logs rounded, and its widest values."""
_FITTED, _TAUGHT, _BEFORE, _GIVEN = 300, 400, 200, 50
"""Tips that scales are fitted to at once, and that condition a prediction at most: of other sessions, of the episodes
before, and given ones; evenly chosen, for time."""
_JUDGED = 20
"""Episodes of each session that spreads and regressions are fitted to at most."""
_LEVEL, _NORMAL, _SURE = 0.9, 1.645, 0.95
"""Share of tips that stated spreads are to hold for, the normal distribution's quantile for it, and the level at which
sessions must err less than without what was learned."""
_RIDGE = 1.0
"""Penalty of the square of each weight of a logistic regression whose features have deviations of 1."""
Rows = Float[np.ndarray, "n 7"]
"""Tips: place x, y, z, mm; travel of the drive, mm, and turning, rad, since the first tip; session and episode."""


@dataclass(frozen=True, eq=False)
class LoggedEpisode:
    """An episode beside its replay.

    Attributes:
        session: name of its log.
        given: which tips are given; the others are predicted.
        at: where kinematics have the tip, on the centerline of the real branch and of the predicted one, LPS mm.
        axes: unit vectors there along the vessel, and to its left as the camera sees it.
        apart: what the real tip is off by, on those axes, mm.
        travel: of the drive since the first tip, mm.
        turned: likewise, rad.
        sure: share of the worlds in the branch that is predicted.
        right: whether it is the real one.
        core: distance of the core's tip from the real one, as the camera sees it, mm.
    """

    session: str
    given: Bool[np.ndarray, "tips"]
    at: Float[np.ndarray, "2 tips 3"]
    axes: Float[np.ndarray, "2 tips axes 3"]
    apart: Float[np.ndarray, "2 tips axes"]
    travel: Float[np.ndarray, "tips"]
    turned: Float[np.ndarray, "tips"]
    sure: Float[np.ndarray, "tips"]
    right: Bool[np.ndarray, "tips"]
    core: Float[np.ndarray, "tips"]

    @property
    def jumps(self) -> Bool[np.ndarray, "tips"]:
        """Steps in which the real tip jumps, each by the tip that it ends with."""
        by = np.diff(self.apart[0], axis=0, prepend=self.apart[0, :1])
        return np.linalg.norm(by, axis=1) > JUMP_MM

    def rows(self, session: int, number: int, *, predicted: bool = False) -> Rows:
        """Return its tips, in the real branch or in the predicted one."""
        of = np.broadcast_to([session, number], (len(self.given), 2))
        return np.column_stack([self.at[int(predicted)], self.travel, self.turned, of])


def logged(of: Prepared, replays: Sequence[EpisodeReplay]) -> list[LoggedEpisode]:
    """Return episodes beside their replays."""
    at_tips = {"at_s": of.courses.seen_s, "latency_s": np.zeros(1), "gain": np.ones(1), "play": np.zeros(1)}
    turns, found = of.courses.followed(1, **at_tips)[0], []
    for log, replay, turn in zip(of.logs, replays, turns, strict=True):
        ray = np.array([0.0, 0.0, 1.0]) if log.camera is None else log.camera.rays(log.pixel[log.seen])[1]
        branches = replay.branch[:, 0], np.where(replay.given, *replay.branch.T)
        at, along = np.stack([_on_lines(of.anatomy.tree, replay.driven, each) for each in branches], axis=1)
        left = np.cross(ray, along)
        axes = np.stack([along, left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-9)], axis=-2)
        apart = ((replay.seen - at)[:, :, None] * axes).sum(axis=-1)
        steps = (np.abs(np.diff(each, prepend=each[0])) for each in (replay.driven, turn[: len(replay.given)]))
        right, core = replay.branch[:, 0] == replay.branch[:, 1], np.linalg.norm(replay.in_view, axis=1)
        travel, turned = (np.cumsum(each) for each in steps)
        found.append(LoggedEpisode(log.name, replay.given, at, axes, apart, travel, turned, replay.sure, right, core))
    return found


def _on_lines(
    tree: VesselTree, abscissa: Float[np.ndarray, "tips"], branch: Float[np.ndarray, "tips"]
) -> tuple[Float[np.ndarray, "tips 3"], Float[np.ndarray, "tips 3"]]:
    """Return points at abscissas on the lines to some branches, and unit vectors along them."""
    found = np.empty((3, len(branch), 3))
    for one in np.unique(branch):
        line, here = tree.path(int(one)), branch == one
        ends = line.abscissa[[0, -1]]
        middle = np.clip(abscissa[here], ends[0] + _ALONG_MM, ends[1] - _ALONG_MM)  # a line has a direction to its ends
        places = np.stack([middle - _ALONG_MM, np.clip(abscissa[here], *ends), middle + _ALONG_MM])
        found[:, here] = np.stack([np.interp(places, line.abscissa, column) for column in line.points.T], axis=-1)
    along = found[2] - found[0]
    return found[1], along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


@dataclass(frozen=True, eq=False)
class Learned:
    """What is predicted of the tips of an episode that are not given.

    Attributes:
        apart: what the tip is off by on both axes, mm.
        sd: standard deviations of it, mm.
        right: probability that the core's branch is the real one.
        jump: probability that the tip jumps in the step that ends there.
    """

    apart: Float[np.ndarray, "tips axes"]
    sd: Float[np.ndarray, "tips axes"]
    right: Float[np.ndarray, "tips"]
    jump: Float[np.ndarray, "tips"]


def _alike(a: Float[np.ndarray, "a 7"], b: Float[np.ndarray, "b 7"]) -> Float[np.ndarray, "5 a b"]:
    """Return squares of distances, differences of travel and turning, and whether session and episode are the same."""
    apart = np.abs(a[:, None] - b)
    return np.stack([(apart[..., :3] ** 2).sum(axis=-1), *np.moveaxis(apart[..., 3:5], -1, 0), *(
        np.moveaxis(apart[..., 5:] == 0, -1, 0))])  # fmt: skip


def _covariance(alike: Float[np.ndarray, "5 a b"], scales: Float[np.ndarray, "7"]) -> Float[np.ndarray, "a b"]:
    """Return the covariance of what tips are off by, without noise, mm²."""
    place_mm, length_mm, shared, episode_mm, travel_mm, turned_rad, _ = scales
    far, travel, turned, session, episode = alike
    place = place_mm**2 * np.exp(-far / (2 * length_mm**2)) * (shared + (1 - shared) * session)
    return place + episode_mm**2 * episode * np.exp(-travel / travel_mm - turned / turned_rad)


@dataclass(frozen=True, eq=False)
class LearnedTip:
    """What was learned of the tips of some sessions in one vessel.

    Attributes:
        sessions: that it was learned from.
        vessel: SHA-256 of the vessel.
        scales: of each axis: deviation of what places add, mm, the length over which they are alike, mm, and the share
            of its variance that all sessions have in common; deviation of what an episode adds, mm, travel, mm, and
            turning, rad, after which 1/e of it is left; noise, mm.
        spread: of each axis, by how much errors in sessions that were left out are larger than stated.
        rows: tips of the sessions.
        apart: what these are off by, mm.
        branch: regression of the branch: weights, means and deviations of its features.
        jump: of jumps.
    """

    sessions: tuple[str, ...]
    vessel: str
    scales: Float[np.ndarray, "axes 7"]
    spread: Float[np.ndarray, "axes"]
    rows: Rows
    apart: Float[np.ndarray, "n axes"]
    branch: Float[np.ndarray, "features 3"]
    jump: Float[np.ndarray, "features 3"]

    def predict(self, episode: LoggedEpisode, before: Sequence[LoggedEpisode] = ()) -> Learned:
        """Return what is predicted of an episode after its given tips.

        Args:
            episode: its other tips are not read.
            before: episodes of the same log before it, with all of their tips.
        """
        given, own = episode.given, len(self.sessions)
        parts = [(self.rows, self.apart)]
        if before:
            rows = np.concatenate([each.rows(own, -1 - k) for k, each in enumerate(before)])
            chosen = evenly(len(rows), _BEFORE)
            parts.append((rows[chosen], np.concatenate([each.apart[0] for each in before])[chosen]))
        chosen = np.flatnonzero(given)[evenly(int(given.sum()), _GIVEN)]
        parts.append((episode.rows(own, -1 - len(before))[chosen], episode.apart[0, chosen]))
        known, y = (np.concatenate(each) for each in zip(*parts, strict=True))
        wanted = episode.rows(own, -1 - len(before), predicted=True)[~given]
        inner, outer, made = _alike(known, known), _alike(wanted, known), []
        for k, scales in enumerate(self.scales):
            noise, cross = scales[-1] ** 2, _covariance(outer, scales)
            factor = cho_factor(_covariance(inner, scales) + noise * np.eye(len(known)))
            left = scales[0] ** 2 + scales[3] ** 2 - (cross * cho_solve(factor, cross.T).T).sum(axis=1)
            made.append((cross @ cho_solve(factor, y[:, k]), np.sqrt(np.maximum(left, 0.0) + noise) * self.spread[k]))
        apart, sd = np.moveaxis(np.array(made), 0, -1)
        right = _chance(self.branch, _branch_features(episode, before)[~given])
        return Learned(apart, sd, right, _chance(self.jump, _jump_features(episode)[~given]))

    def write(self, path: Path) -> None:
        """Write a file, whole or not at all."""
        with writing(path) as partial, partial.open("wb") as stream:
            np.savez_compressed(stream, **vars(self))  # pyright: ignore[reportArgumentType]


def read_learned(path: Path) -> LearnedTip:
    """Return what `LearnedTip.write` wrote.

    Raises:
        InputError: the file is missing, or holds something else.
    """
    mend = "make it again with `endopilot train --logs`"
    if not regular(path).exists():
        raise InputError(f"{path}: no such file; {mend}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {each.name: file[each.name] for each in fields(LearnedTip)}
    except (BadZipFile, KeyError, ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: damaged, or not what was learned from logs ({error}); {mend}") from error
    return LearnedTip(**arrays | {"sessions": tuple(arrays["sessions"].tolist()), "vessel": str(arrays["vessel"])})


def learn(episodes: Sequence[LoggedEpisode], vessel: str) -> LearnedTip:
    """Learn from episodes of some sessions in one vessel.

    Spreads, and both regressions, are fitted to what the others say of each session.

    Args:
        episodes: in the order of each log.
        vessel: its SHA-256.
    """
    names = _names(episodes)
    rows = [each.rows(names.index(each.session), k) for k, each in enumerate(episodes)]
    tips, apart = np.concatenate(rows), np.concatenate([each.apart[0] for each in episodes])
    of = [np.flatnonzero(tips[:, 5] == k) for k in range(len(names))]
    taught = np.concatenate([each[evenly(len(each), _TAUGHT // len(names))] for each in of])
    scales, nothing = np.stack([_scales(tips, apart[:, k]) for k in (0, 1)]), np.zeros((3, 3))
    made = LearnedTip(tuple(names), vessel, scales, np.ones(2), tips[taught], apart[taught], nothing, nothing)
    z, branches, jumps = [], [], []
    for k, name in enumerate(names):
        other, own = made.rows[:, 5] != k, [each for each in episodes if each.session == name]
        model = replace(made, rows=made.rows[other], apart=made.apart[other])
        for j in evenly(len(own), _JUDGED):
            each, rest, said = own[j], ~own[j].given, model.predict(own[j], own[:j])
            z.append((np.abs(said.apart - each.apart[1, rest]) / said.sd)[each.right[rest]])
            branches.append((_branch_features(each, own[:j])[rest], each.right[rest]))
            jumps.append((_jump_features(each)[rest], each.jumps[rest]))
    spread = np.quantile(np.concatenate([*z, np.full((1, 2), _NORMAL)]), _LEVEL, axis=0) / _NORMAL
    branch, jump = (_logistic(*map(np.concatenate, zip(*pairs, strict=True))) for pairs in (branches, jumps))
    return replace(made, spread=spread, branch=branch, jump=jump)


def _scales(tips: Rows, apart: Float[np.ndarray, "n"]) -> Float[np.ndarray, "7"]:
    """Return the likeliest scales of one axis: of tips of some episodes of all sessions, and of others."""
    some = []
    for first in (0, 1):
        episodes = np.unique(tips[:, 6])[first::2]
        chosen = np.isin(tips[:, 6], episodes[evenly(len(episodes), _FITTED // 20)]).nonzero()[0]
        chosen = chosen[evenly(len(chosen), _FITTED)]
        some += [(_alike(tips[chosen], tips[chosen]), apart[chosen])] if len(chosen) else []

    def cost(logs: Float[np.ndarray, "7"]) -> float:
        total = 0.0
        for alike, y in some:
            factor = cho_factor(_covariance(alike, np.exp(logs)) + np.exp(2 * logs[-1]) * np.eye(len(y)))
            total += np.log(np.diag(factor[0])).sum() + 0.5 * y @ cho_solve(factor, y)
        return float(total)

    found = minimize(
        cost, np.log(_FIRST), method="L-BFGS-B", bounds=np.log(_RANGES).tolist(), options={"maxiter": 12, "eps": 1e-3}
    )
    return np.exp(found.x)


def _names(episodes: Sequence[LoggedEpisode]) -> list[str]:
    return list(dict.fromkeys(each.session for each in episodes))


def _branch_features(episode: LoggedEpisode, before: Sequence[LoggedEpisode]) -> Float[np.ndarray, "tips 2"]:
    """Return log odds of the worlds in the branch, and of the core's in the log's episodes before."""
    sure = np.clip(episode.sure, 0.02, 0.98)
    right = sum(bool(each.right[-1]) for each in before)
    past = np.log((right + 1) / (len(before) - right + 1))
    return np.column_stack([np.log(sure / (1 - sure)), np.full(len(sure), past)])


def _jump_features(episode: LoggedEpisode) -> Float[np.ndarray, "tips 2"]:
    """Return logarithms of travel and turning in the step to each tip, above 0.03 mm and rad."""
    steps = [np.diff(each, prepend=each[0]) for each in (episode.travel, episode.turned)]
    return np.log(np.column_stack(steps) + 0.03)


def _logistic(features: Float[np.ndarray, "n k"], truth: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "features 3"]:
    """Return a bias and weights, with means and deviations of the features, of a logistic regression (Newton)."""
    middle, deviation = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    x = np.column_stack([np.ones(len(features)), (features - middle) / deviation])
    weight, penalty = np.zeros(x.shape[1]), _RIDGE * np.eye(x.shape[1])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-x @ weight))
        weight -= np.linalg.solve(
            (x.T * (chance * (1 - chance))) @ x + penalty, x.T @ (chance - truth) + penalty @ weight
        )
    return np.column_stack([weight, np.append(0.0, middle), np.append(1.0, deviation)])


def _chance(regression: Float[np.ndarray, "features 3"], features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n"]:
    weight, middle, deviation = regression.T
    return 1 / (1 + np.exp(-(weight[0] + ((features - middle[1:]) / np.maximum(deviation[1:], 1e-6)) @ weight[1:])))


def left_out(episodes: Sequence[LoggedEpisode], vessel: str, *, sessions: int, before: bool = True) -> list[Learned]:
    """Return what is predicted of each episode, in the order of each log, by what other sessions teach.

    Args:
        episodes: of all sessions.
        vessel: its SHA-256.
        sessions: how many teach: those that follow the one left out, in a circle.
        before: whether the same log's episodes before are known.
    """
    names, found = _names(episodes), []
    for k, name in enumerate(names):
        others = [names[(k + 1 + j) % len(names)] for j in range(sessions)]
        model = learn([each for each in episodes if each.session in others], vessel)
        own = [each for each in episodes if each.session == name]
        found += [model.predict(each, own[:j] if before else ()) for j, each in enumerate(own)]
    return found


def figures(episodes: Sequence[LoggedEpisode], learned: Sequence[Learned]) -> dict[str, float | int | bool | None]:
    """Return medians over episodes of errors in what was not given, and how well the stated uncertainty holds.

    `gain` says whether sessions err less than by the better of kinematics, on the real branch, and the core, at 95 %;
    a skill is by what share the Brier score of probabilities is better than that of the frequency alone.
    """
    pairs = [(each, ~each.given, said) for each, said in zip(episodes, learned, strict=True)]
    errors = {
        "kinematics": [np.median(np.linalg.norm(each.apart[0, rest], axis=1)) for each, rest, _ in pairs],
        "core": [np.median(each.core[rest]) for each, rest, _ in pairs],
        "learned": [np.median(np.linalg.norm(each.apart[1, rest] - said.apart, axis=1)) for each, rest, said in pairs],
    }
    unit = np.unique([each.session for each in episodes], return_inverse=True)[1]
    by_session = {name: np.bincount(unit, each) / np.bincount(unit) for name, each in errors.items()}
    best = min(("kinematics", "core"), key=lambda name: float(np.median(errors[name])))
    within = [
        (np.abs(each.apart[1, rest] - said.apart) <= _NORMAL * said.sd)[each.right[rest]] for each, rest, said in pairs
    ]
    found: dict[str, float | int | bool | None] = {
        f"in_plane_of_{name}_mm": float(np.median(each)) for name, each in errors.items()
    }
    found["gain"] = earns(by_session[best], by_session["learned"], _SURE) if unit.any() else None
    found["bands_of_90_percent_hold_share"] = float(np.concatenate(within).mean())
    jumps, jump = (np.concatenate(each) for each in zip(*((e.jumps[r], s.jump) for e, r, s in pairs), strict=True))
    ends, end = np.array([(each.right[-1], said.right[-1]) for each, _, said in pairs]).T
    for name, real, said in (("jumps", jumps, jump), ("real_branch_ends", ends, end)):
        found |= {name: int(real.sum()), f"{name}_expected": float(said.sum())}
        found[f"{name}_skill"] = float(1 - ((said - real) ** 2).mean() / max(float(real.var()), 1e-9))
    return found
