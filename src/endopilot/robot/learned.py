"""What logs teach beyond the simulator: by how much a real tip is beside where drive and rod core have it, `learn`.

Kinematics lead the tip along the branch that the core takes (`replay`). What the real tip is off by, along the vessel
and to its side, is on each axis the sum of three Gaussian processes and noise (kriging; Rasmussen & Williams 2006,
chapters 2 and 5):

* a map of the vessel, the same in all sessions; what the training sessions say of it has a covariance of its own;
* what a session adds to it: another wire, or camera, drives there all day;
* what an episode adds, which is forgotten as the wire slides and turns.

Given tips, and the same log's episodes before, condition them. All scales follow from the likelihood of the logs.
Whether the core's branch is the real one, and whether the tip jumps in a step, are logistic regressions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from endopilot.errors import InputError
from endopilot.files import reading, regular, writing
from endopilot.robot.kinematics import earns
from endopilot.robot.replay import EpisodeReplay, Prepared
from endopilot.types import VesselTree

AXES = 2
"""Along the vessel, and to its left as the camera sees it."""
JUMP_MM = 0.57
"""A tip jumps that moves by so much more, or otherwise, than its drive in one step: six pixels of the public logs."""
_PLACE_MM = 1.0
"""Distance of the places of the map, mm: less than any length over which a tip's side changes in the public logs."""
_FIRST = np.log([0.25, 2.0, 0.25, 10.0, 3.0, 0.12])
_RANGES = np.log([[0.01, 2.0], [0.5, 20.0], [0.01, 2.0], [0.5, 100.0], [0.2, 100.0], [0.02, 1.0]])
"""Where the search for `LearnedTip.scales` begins, mm and rad, and its widest values."""
_SHARES = np.linspace(0.0, 0.9, 10)
_EPISODES, _TIPS, _BEFORE = 10, 20, 200
"""Episodes of a session and tips of each that scales are fitted to at most, and tips of the episodes before that
condition a prediction, evenly chosen: for memory and time."""
_LEVEL, _NORMAL, _SURE = 0.9, 1.645, 0.95
"""Share of tips that stated spreads are to hold for, the normal distribution's quantile for it, and the level at which
sessions must err less than without what was learned."""
_RIDGE = 1.0
"""Penalty of the square of each weight of a logistic regression whose features have deviations of 1."""


@dataclass(frozen=True, eq=False)
class LoggedEpisode:
    """An episode beside its replay.

    Attributes:
        session: name of its log.
        given: which tips are given; the others are predicted.
        at: where kinematics have the tip, on the centerline of the real branch and of the predicted one, LPS mm.
        axes: unit vectors along and to the left there.
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


def logged(of: Prepared, replays: Sequence[EpisodeReplay]) -> list[LoggedEpisode]:
    """Return episodes beside their replays."""
    found = []
    turns = of.courses.followed(
        1, at_s=of.courses.seen_s, latency_s=np.zeros(1), gain=np.ones(1), play=np.zeros(1)
    )[0]  # fmt: skip
    for k, (log, replay) in enumerate(zip(of.logs, replays, strict=True)):
        count, ray = len(replay.given), np.array([0.0, 0.0, 1.0])
        if log.camera is not None:
            ray = log.camera.rays(log.pixel[log.seen])[1]
        branches = replay.branch[:, 0], np.where(replay.given, *replay.branch.T)
        at, along = np.stack([_on_lines(of.anatomy.tree, replay.driven, each) for each in branches], axis=1)
        left = np.cross(ray, along)
        axes = np.stack([along, left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-9)], axis=-2)
        apart = ((replay.seen - at)[:, :, None] * axes).sum(axis=-1)
        travel, turned = (
            np.cumsum(np.abs(np.diff(each, prepend=each[0]))) for each in (replay.driven, turns[k, :count])
        )
        right, core = replay.branch[:, 0] == replay.branch[:, 1], np.linalg.norm(replay.in_view, axis=1)
        found.append(LoggedEpisode(log.name, replay.given, at, axes, apart, travel, turned, replay.sure, right, core))
    return found


def _on_lines(
    tree: VesselTree, abscissa: Float[np.ndarray, "tips"], branch: Float[np.ndarray, "tips"]
) -> tuple[Float[np.ndarray, "tips 3"], Float[np.ndarray, "tips 3"]]:
    """Return points at abscissas on the lines to some branches, and unit vectors along them over `_PLACE_MM`."""
    point, along = np.empty((len(branch), 3)), np.empty((len(branch), 3))
    for one in np.unique(branch):
        line, here = tree.path(int(one)), branch == one
        on = np.stack([np.interp(abscissa[here], line.abscissa, column) for column in line.points.T], axis=-1)
        steps = abscissa[here, None] + np.array([-_PLACE_MM, _PLACE_MM])
        steps = np.clip(steps, *line.abscissa[[0, -1]])
        ends = np.stack([np.interp(steps, line.abscissa, column) for column in line.points.T], axis=-1)
        point[here], along[here] = on, np.diff(ends, axis=1)[:, 0]
    return point, along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


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


@dataclass(frozen=True, eq=False)
class _Tips:
    """Some tips, one after the other; `of` numbers their episodes."""

    at: Float[np.ndarray, "n 3"]
    travel: Float[np.ndarray, "n"]
    turned: Float[np.ndarray, "n"]
    of: Int[np.ndarray, "n"]
    apart: Float[np.ndarray, "n axes"]

    @staticmethod
    def take(
        episodes: Sequence[LoggedEpisode], rows: Sequence[Int[np.ndarray, "rows"]], *, predicted: bool = False
    ) -> _Tips:
        """Return rows of episodes, in the real branch or in the predicted one."""
        pairs, k = list(zip(episodes, rows, strict=True)), int(predicted)
        return _Tips(
            np.concatenate([each.at[k, at] for each, at in pairs]),
            np.concatenate([each.travel[at] for each, at in pairs]),
            np.concatenate([each.turned[at] for each, at in pairs]),
            np.repeat(np.arange(len(pairs)), [len(at) for _, at in pairs]),
            np.concatenate([each.apart[k, at] for each, at in pairs]),
        )


def _near(a: _Tips, b: _Tips, scales: Float[np.ndarray, "6"]) -> tuple[np.ndarray, np.ndarray]:
    """Return covariances of what places add, as shares of their variance, and of what episodes add, mm²."""
    _, place_mm, episode_mm, travel_mm, turned_rad, _ = scales
    far = ((a.at[:, None] - b.at) ** 2).sum(axis=-1)
    since = np.abs(a.travel[:, None] - b.travel) / travel_mm + np.abs(a.turned[:, None] - b.turned) / turned_rad
    return np.exp(-far / (2 * place_mm**2)), episode_mm**2 * (a.of[:, None] == b.of) * np.exp(-since)


@dataclass(frozen=True, eq=False)
class LearnedTip:
    """What was learned of the tips of some sessions in one vessel.

    Attributes:
        sessions: that it was learned from.
        vessel: SHA-256 of the vessel.
        scales: of each axis: deviation of what places add, and the length over which they are alike, mm; deviation of
            what an episode adds, mm, travel, mm, and turning, rad, after which 1/e of it is left; noise, mm.
        shared: of each axis, the share of the places' variance that all sessions have in common.
        spread: of each axis, by how much errors in sessions that were left out are larger than stated.
        places: of the map, LPS mm.
        mean: of each axis there, mm.
        covariance: of each axis between places, mm².
        branch: weights of the regression of the branch.
        jump: weights of the regression of jumps.
    """

    sessions: tuple[str, ...]
    vessel: str
    scales: Float[np.ndarray, "axes 6"]
    shared: Float[np.ndarray, "axes"]
    spread: Float[np.ndarray, "axes"]
    places: Float[np.ndarray, "places 3"]
    mean: Float[np.ndarray, "axes places"]
    covariance: Float[np.ndarray, "axes places places"]
    branch: Float[np.ndarray, "features 3"]
    jump: Float[np.ndarray, "features 3"]

    def predict(self, episode: LoggedEpisode, before: Sequence[LoggedEpisode] = ()) -> Learned:
        """Return what is predicted of an episode after its given tips.

        Args:
            episode: its other tips are not read.
            before: episodes of the same log before it, with all of their tips.
        """
        apart, sd = self._krige(episode, before)
        right = _chance(self.branch, _branch_features(episode, before)[~episode.given])
        return Learned(apart, sd * self.spread, right, _chance(self.jump, _jump_features(episode, apart)))

    def _krige(
        self, episode: LoggedEpisode, before: Sequence[LoggedEpisode]
    ) -> tuple[Float[np.ndarray, "tips axes"], Float[np.ndarray, "tips axes"]]:
        last = np.flatnonzero(episode.given)
        each = max(1, _BEFORE // max(1, len(before)))
        rows = [_evenly(len(one.given), each) for one in before]
        known = _Tips.take([*before, episode], [*rows, last[_evenly(len(last), _BEFORE // 4)]])
        wanted = _Tips.take([episode], [np.flatnonzero(~episode.given)], predicted=True)
        wanted.of[:] = len(before)
        there, here = (self._place(tips.at) for tips in (known, wanted))
        made = np.empty((2, len(wanted.at), AXES))
        for k, scales in enumerate(self.scales):
            own, noise = (1 - self.shared[k]) * scales[0] ** 2, scales[-1] ** 2
            inner, outer = (_near(a, known, scales) for a in (known, wanted))
            inner = self.covariance[k][np.ix_(there, there)] + own * inner[0] + inner[1]
            outer = self.covariance[k][np.ix_(here, there)] + own * outer[0] + outer[1]
            factor = cho_factor(inner + noise * np.eye(len(inner)))
            made[0, :, k] = self.mean[k, here] + outer @ cho_solve(factor, known.apart[:, k] - self.mean[k, there])
            prior = np.diag(self.covariance[k])[here] + own + scales[2] ** 2 + noise
            made[1, :, k] = np.sqrt(np.maximum(prior - (outer * cho_solve(factor, outer.T).T).sum(axis=1), noise))
        return made[0], made[1]

    def _place(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        return ((points[:, None] - self.places) ** 2).sum(axis=-1).argmin(axis=1)

    def write(self, path: Path) -> None:
        """Write a file, whole or not at all."""
        with writing(path) as partial, partial.open("wb") as stream:
            np.savez_compressed(stream, **{each.name: getattr(self, each.name) for each in fields(self)})  # pyright: ignore[reportArgumentType]


def read_learned(path: Path) -> LearnedTip:
    """Return what `LearnedTip.write` wrote.

    Raises:
        InputError: the file is missing, or holds something else.
    """
    mend = "make it again with `endopilot train --logs`"
    if not regular(path).exists():
        raise InputError(f"{path}: no such file; {mend}")
    with reading(path, mend), np.load(path, allow_pickle=False) as file:
        arrays = {each.name: file[each.name] for each in fields(LearnedTip)}
    return LearnedTip(**arrays | {"sessions": tuple(arrays["sessions"].tolist()), "vessel": str(arrays["vessel"])})


def _evenly(count: int, most: int) -> Int[np.ndarray, "rows"]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def learn(episodes: Sequence[LoggedEpisode], tree: VesselTree, vessel: str) -> LearnedTip:
    """Learn from episodes of some sessions in one vessel.

    Spreads, and both regressions, are fitted to what the others say of each session.

    Args:
        episodes: in the order of each log.
        tree: the vessel.
        vessel: its SHA-256.
    """
    by_session = {name: [each for each in episodes if each.session == name] for name in _names(episodes)}
    scales = np.stack([_scales(list(by_session.values()), axis) for axis in range(AXES)])
    lines = [
        _evenly(len(b.centerline.points), int(np.ptp(b.centerline.abscissa) / _PLACE_MM) + 2) for b in tree.branches
    ]
    places = np.concatenate([b.centerline.points[rows] for b, rows in zip(tree.branches, lines, strict=True)])
    nothing = np.zeros((3, 3))

    def of(names: Sequence[str]) -> LearnedTip:
        parts = [_map([by_session[name] for name in names], places, scales[k], k) for k in range(AXES)]
        shared, mean, covariance = (np.stack(each) for each in zip(*parts, strict=True))
        return LearnedTip(
            tuple(names), vessel, scales, shared, np.ones(AXES), places, mean, covariance, nothing, nothing
        )

    z, branches, jumps = [], [], []
    for name, own in by_session.items():
        model = of([other for other in by_session if other != name])
        for k in _evenly(len(own), 2 * _EPISODES):
            episode, rest = own[k], ~own[k].given
            apart, sd = model._krige(episode, own[:k])
            z.append(np.abs(apart - episode.apart[1, rest])[episode.right[rest]] / sd[episode.right[rest]])
            branches.append((_branch_features(episode, own[:k])[rest], episode.right[rest]))
            jumps.append((_jump_features(episode, apart), episode.jumps[rest]))
    spread = np.quantile(np.concatenate(z), _LEVEL, axis=0) / _NORMAL
    branch, jump = (_logistic(*map(np.concatenate, zip(*pairs, strict=True))) for pairs in (branches, jumps))
    return replace(of(list(by_session)), spread=spread, branch=branch, jump=jump)


def left_out(episodes: Sequence[LoggedEpisode], tree: VesselTree, vessel: str, sessions: int) -> dict[str, LearnedTip]:
    """Return what so many other sessions teach of each: those that follow it, in a circle."""
    names, found = _names(episodes), {}
    for k, name in enumerate(names):
        others = [names[(k + 1 + j) % len(names)] for j in range(sessions)]
        found[name] = learn([each for each in episodes if each.session in others], tree, vessel)
    return found


def predicted(
    models: Mapping[str, LearnedTip], episodes: Sequence[LoggedEpisode], *, before: bool = True
) -> list[Learned]:
    """Return what each session's model says of its episodes, in the order of each log.

    Args:
        models: by session.
        episodes: what is predicted.
        before: whether the same log's episodes before are known.
    """
    past: dict[str, list[LoggedEpisode]] = {name: [] for name in models}
    found = []
    for each in episodes:
        found.append(models[each.session].predict(each, past[each.session] if before else ()))
        past[each.session].append(each)
    return found


def judged(
    episodes: Sequence[LoggedEpisode], tree: VesselTree, vessel: str
) -> list[dict[str, float | int | bool | None]]:
    """Return `figures` of sessions that were left out, by how many others teach: 1, 2, 4 and all."""
    most = len(_names(episodes)) - 1
    rows = []
    for count in [*(k for k in (1, 2, 4) if k < most), *([most] if most else [])]:
        said = predicted(left_out(episodes, tree, vessel, count), episodes)
        rows.append({"sessions": count} | figures(episodes, said))
    return rows


def figures(episodes: Sequence[LoggedEpisode], learned: Sequence[Learned]) -> dict[str, float | int | bool | None]:
    """Return medians over episodes of errors in what was not given, and how well the stated uncertainty holds.

    `gain` says whether sessions err less than by the better of kinematics, on the real branch, and the core, at 95 %.
    """
    pairs = [(each, ~each.given, said) for each, said in zip(episodes, learned, strict=True)]
    errors = {
        "kinematics": [np.median(np.linalg.norm(each.apart[0, rest], axis=1)) for each, rest, _ in pairs],
        "core": [np.median(each.core[rest]) for each, rest, _ in pairs],
        "learned": [np.median(np.linalg.norm(each.apart[1, rest] - said.apart, axis=1)) for each, rest, said in pairs],
    }
    found: dict[str, float | int | bool | None] = {
        f"in_plane_of_{name}_mm": float(np.median(each)) for name, each in errors.items()
    }
    within = [
        (np.abs(each.apart[1, rest] - said.apart) <= _NORMAL * said.sd)[each.right[rest]] for each, rest, said in pairs
    ]
    unit = np.unique([each.session for each in episodes], return_inverse=True)[1]
    by_session = {name: np.bincount(unit, each) / np.bincount(unit) for name, each in errors.items()}
    best = min(("kinematics", "core"), key=lambda name: float(np.median(errors[name])))
    jumps, ends = np.concatenate([each.jumps[rest] for each, rest, _ in pairs]), [each.right[-1] for each in episodes]
    return found | {
        "gain": earns(by_session[best], by_session["learned"], _SURE) if len(by_session[best]) > 1 else None,
        "bands_of_90_percent_hold_share": float(np.concatenate(within).mean()),
        "jumps": int(jumps.sum()),
        "jumps_expected": float(sum(said.jump.sum() for _, _, said in pairs)),
        "jump_skill": skill(np.concatenate([said.jump for _, _, said in pairs]), jumps),
        "ends_in_the_real_branch_share": float(np.mean(ends)),
        "ends_expected_share": float(np.mean([said.right[-1] for _, _, said in pairs])),
        "branch_skill": skill(np.array([said.right[-1] for _, _, said in pairs]), np.array(ends)),
    }


def skill(chance: Float[np.ndarray, "n"], truth: Bool[np.ndarray, "n"]) -> float:
    """Return by what share the Brier score is better than that of the frequency alone."""
    return float(1 - ((chance - truth) ** 2).mean() / max(float(truth.var()), 1e-9))


def _names(episodes: Sequence[LoggedEpisode]) -> list[str]:
    return list(dict.fromkeys(each.session for each in episodes))


def _scales(sessions: Sequence[Sequence[LoggedEpisode]], axis: int) -> Float[np.ndarray, "6"]:
    """Return the likeliest scales of one axis, each session by itself, places shared or not."""
    some = []
    for session in sessions:
        chosen = [session[k] for k in _evenly(len(session), _EPISODES)]
        some.append(_Tips.take(chosen, [_evenly(len(each.given), _TIPS) for each in chosen]))

    def cost(logs: Float[np.ndarray, "6"]) -> float:
        scales, total = np.exp(logs), 0.0
        for tips in some:
            places, own = _near(tips, tips, scales)
            noise = scales[-1] ** 2 * np.eye(len(places))
            factor = cholesky(scales[0] ** 2 * places + own + noise, lower=True, check_finite=False)
            white = solve_triangular(factor, tips.apart[:, axis], lower=True, check_finite=False)
            total += np.log(np.diag(factor)).sum() + 0.5 * (white**2).sum()
        return float(total)

    found = minimize(cost, _FIRST, method="L-BFGS-B", bounds=_RANGES.tolist(), options={"maxiter": 12, "eps": 1e-3})
    return np.exp(found.x)


def _map(
    sessions: Sequence[Sequence[LoggedEpisode]],
    places: Float[np.ndarray, "places 3"],
    scales: Float[np.ndarray, "6"],
    axis: int,
) -> tuple[float, Float[np.ndarray, "places"], Float[np.ndarray, "places places"]]:
    """Return the shared part of what places add, and what sessions say of it: its mean and covariance at places.

    Of each session the mean over its episodes at a place counts, which is as sure as these are many.
    """
    at, of, mean, noise = [], [], [], []
    for k, session in enumerate(sessions):
        nearest = [((e.at[0][:, None] - places) ** 2).sum(axis=-1).argmin(axis=1) for e in session]
        for place in np.unique(np.concatenate(nearest)):
            own = [e.apart[0, n == place, axis] for e, n in zip(session, nearest, strict=True) if (n == place).any()]
            at.append(place)
            of.append(k)
            mean.append(np.mean([each.mean() for each in own]))
            noise.append(np.mean([scales[2] ** 2 + scales[-1] ** 2 / len(each) for each in own]) / len(own))
    alike = np.exp(-((places[:, None] - places) ** 2).sum(axis=-1) / (2 * scales[1] ** 2))
    between, session, y = alike[np.ix_(at, at)], np.array(of), np.array(mean)
    best, chosen = np.inf, (0.0, np.zeros(len(places)), np.zeros_like(alike))
    for share in _SHARES if len(at) else ():
        whole = scales[0] ** 2 * (share + (1 - share) * (session[:, None] == session)) * between + np.diag(noise)
        factor = cho_factor(whole, lower=True)
        cost = np.log(np.diag(factor[0])).sum() + 0.5 * y @ cho_solve(factor, y)
        if cost < best:
            outer = share * scales[0] ** 2 * alike[:, at]
            covariance = share * scales[0] ** 2 * alike - outer @ cho_solve(factor, outer.T)
            best, chosen = cost, (float(share), outer @ cho_solve(factor, y), covariance)
    return chosen


def _branch_features(episode: LoggedEpisode, before: Sequence[LoggedEpisode]) -> Float[np.ndarray, "tips 2"]:
    """Return log odds of the worlds in the branch, and of the core's in the log's episodes before."""
    sure = np.clip(episode.sure, 0.02, 0.98)
    right = sum(bool(each.right[-1]) for each in before)
    past = np.log((right + 1) / (len(before) - right + 1))
    return np.column_stack([np.log(sure / (1 - sure)), np.full(len(sure), past)])


def _jump_features(episode: LoggedEpisode, apart: Float[np.ndarray, "tips axes"]) -> Float[np.ndarray, "tips 2"]:
    """Return logarithms of travel and turning in the step to each tip that is predicted."""
    steps = [np.diff(each, prepend=each[0])[~episode.given] for each in (episode.travel, episode.turned)]
    return np.log(np.column_stack(steps) + 0.03)


def _logistic(features: Float[np.ndarray, "n k"], truth: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "features 3"]:
    """Return a bias and weights, with means and deviations of the features, of a logistic regression (Newton)."""
    middle, deviation = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-6)
    x = np.column_stack([np.ones(len(features)), (features - middle) / deviation])
    weight, penalty = np.zeros(x.shape[1]), _RIDGE * np.eye(x.shape[1])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-x @ weight))
        hessian = (x.T * (chance * (1 - chance))) @ x + penalty
        weight -= np.linalg.solve(hessian, x.T @ (chance - truth) + penalty @ weight)
    return np.column_stack([weight, np.append(0.0, middle), np.append(1.0, deviation)])


def _chance(regression: Float[np.ndarray, "features 3"], features: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n"]:
    weight, middle, deviation = regression.T
    return 1 / (1 + np.exp(-(weight[0] + ((features - middle[1:]) / deviation[1:]) @ weight[1:])))
