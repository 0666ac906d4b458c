"""What a drive makes of the commands of a log: where the device's proximal end is at any time, with lag, gain and play.

A command moves the drive from where it is to the commanded position by the time of the next one, and it begins
`latency` later. The device follows by `gain` and through the play, as in the simulated robot (`through_play`).
Candidates are computed side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.play import through_play
from endopilot.devices.robot import DriveConfig
from endopilot.robot.log import RobotLog

STARTS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Where in the play a device may begin: nobody logs which way it was driven last."""


@dataclass(frozen=True, eq=False)
class Courses:
    """The commands of episodes, and the times at which the tip was seen, padded to one length.

    Attributes:
        knot_s: times from the start of each episode at which the drive reaches what was commanded, s.
        command: what it reaches then, mm and rad from the first command; device 0.
        seen_s: times at which the tip was seen, s; the last one again as padding.
        seen: which of them are no padding.
    """

    knot_s: Float[np.ndarray, "episodes knots"]
    command: Float[np.ndarray, "episodes knots 2"]
    seen_s: Float[np.ndarray, "episodes tips"]
    seen: Bool[np.ndarray, "episodes tips"]

    @staticmethod
    def of(episodes: Sequence[RobotLog], drive: DriveConfig) -> Courses:
        """Take them from logs of one episode each, with a command and a tip at least.

        A drive that is sent along by velocity ramps from one to the next, and is behind by what a ramp costs for ever
        after; one that is sent to a position gets there.
        """
        acceleration = np.array([drive.max_acceleration_mm_s2, drive.max_acceleration_rad_s2])
        knots = max(int(log.commanded.sum()) for log in episodes) + 1
        tips = max(int(log.seen.sum()) for log in episodes)
        knot_s, command = np.zeros((len(episodes), knots)), np.zeros((len(episodes), knots, 2))
        seen_s, seen = np.zeros((len(episodes), tips)), np.zeros((len(episodes), tips), dtype=bool)
        for k, log in enumerate(episodes):
            asked, at = log.command[log.commanded, 0], log.time_s[log.commanded] - log.time_s[0]
            period = float(np.median(np.diff(at))) if len(at) > 1 else 0.1
            count, looks = len(at), log.time_s[log.seen] - log.time_s[0]
            knot_s[k, 0], knot_s[k, 1 : count + 1] = at[0], [*at[1:], at[-1] + period]
            knot_s[k, count + 1 :] = knot_s[k, count] + 1e-3 * np.arange(1, knots - count)
            place = np.concatenate([asked[:1], asked])
            if log.by_velocity:
                place[0] = 0.0
                velocity = np.diff(place, axis=0) / np.diff(knot_s[k, : count + 1])[:, None]
                change = np.diff(velocity, axis=0, prepend=0.0)
                place[1:] -= np.cumsum(change * np.abs(change) / (2 * acceleration), axis=0)
            command[k, : count + 1], command[k, count + 1 :] = place - place[0], place[-1] - place[0]
            seen_s[k, : len(looks)], seen_s[k, len(looks) :] = looks, looks[-1]
            seen[k, : len(looks)] = True
        return Courses(knot_s, command, seen_s, seen)

    def followed(
        self,
        axis: int,
        *,
        at_s: Float[np.ndarray, "episodes times"],
        latency_s: Float[np.ndarray, "candidates"],
        gain: Float[np.ndarray, "candidates"],
        play: Float[np.ndarray, "candidates"],
        start: float | Float[np.ndarray, "episodes"] = 0.0,
    ) -> Float[np.ndarray, "candidates episodes times"]:
        """Return where the device's proximal end is, from where it was at the first command, mm or rad.

        Args:
            axis: 0 for the translation, 1 for the rotation.
            at_s: times of each episode, s.
            latency_s: from a command to the motion, s.
            gain: motion of the device per motion of the drive.
            play: motion that is lost where the drive reverses, mm or rad.
            start: where in the play the device of each episode begins: -1 it was pushed last, 1 it was pulled last.
        """
        drive = gain[:, None, None] * self.command[None, :, :, axis]
        half = play[:, None] / 2
        ahead = np.empty_like(drive)  # of the device
        ahead[:, :, 0] = -np.clip(start, -1.0, 1.0) * half
        for k in range(1, drive.shape[2]):
            ahead[:, :, k], _ = through_play(ahead[:, :, k - 1], drive[:, :, k] - drive[:, :, k - 1], half)
        result = np.empty((len(gain), *at_s.shape))
        for e, knots in enumerate(self.knot_s):
            since = np.clip(at_s[e] - latency_s[:, None], knots[0], knots[-1])
            before = np.minimum(np.searchsorted(knots, since, side="right") - 1, len(knots) - 2)
            share = (since - knots[before]) / (knots[before + 1] - knots[before])
            left, right, led = (
                np.take_along_axis(each[:, e], at, axis=1)
                for each, at in ((drive, before), (drive, before + 1), (ahead, before))
            )
            driven = share * (right - left)
            result[:, e] = left + driven - through_play(led, driven, half)[0]
        return result
