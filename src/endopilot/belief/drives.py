"""Where the proximal ends of devices are, by encoders that may sit in front of the play of their drives: `Drives`.

Encoders at the devices say it. Encoders at the motors do not: how wide each play is, and where in it the device lies at
the start, is known roughly. Samples of both follow the encoders through the play operator. What X-ray shows of the tip
weights them, and so does the force of the drive: the introducer's valve rubs on a device that moves, and not on one
that rests while its play is taken up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from endopilot.devices.robot import DriveConfig, RobotConfig, through_play
from endopilot.devices.stack import Proximals
from endopilot.tasks.navigation import DECISION_PERIOD_S

_SAMPLES = 2000
_LEAST_SD = 0.15
"""Standard deviation of a play, as a share of what it is known as, at least."""
_LEAST_SHARE = 0.2
"""No play is less than this share of what it is known as."""
_CREEP_SHARE = 0.01
"""Standard deviation of what a device creeps in its grip in a period, as a share of its motion."""
_NEAR = np.array([0.5, 0.5])
"""Samples this near to the median count for the estimate, mm and rad."""
_JITTER = np.array([0.05, 0.04])
"""What weighted samples are moved by, mm and rad, so that none is twice there."""
_GAP_JITTER = 0.01
"""The same of their plays, as a share."""
_STRAY_SHARE, _STRAYS = 0.03, np.array([0.7, 1.0])
"""Share of the samples that may be where none of the others is, and how far from these, mm and rad."""
_FORCE_SD_N, _FORCE_SHARE = 0.02, 0.2
"""Standard deviation of the force that a simulated device predicts, N, and as a share of it."""


def force_sd_n(predicted_n: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"] | float:
    """Return the standard deviation of a force that a simulated device predicts of its drive, N."""
    return np.hypot(_FORCE_SD_N, _FORCE_SHARE * np.abs(predicted_n))


_LEAST_LIKELY = 0.02
"""No force makes a sample less likely than this, as a share of the most likely: simulated devices may be elsewhere."""
_MOVES_MM_S, _TURNS_RAD_S = 0.5, 0.1
"""A motor says something by its force that advances faster than this, mm/s, and turns its device no faster, rad/s."""


def ahead_of_valve_n(load: Proximals, commanded: Proximals, valve: tuple[float, float]) -> float | None:
    """Return the force that the wire's drive reads, N, less the valve's; None where none is measured, or where the wire
    advances so slowly that the valve's friction hides it.

    Args:
        valve: friction of the introducer's valve, N, and its drag, N·s/mm.
    """
    if not load or not commanded or commanded[0][0] < _MOVES_MM_S:
        return None
    return load[0][0] - valve[0] - valve[1] * commanded[0][0]


_TAKEN_UP = np.array([0.05, 0.03])
"""What is left of a play that counts as taken up, mm and rad."""
_WORTH_IT = np.array([0.3, 0.1])
"""A device this near to where it should be stays where a play would have to be taken up first, mm and rad."""


UNKNOWN = RobotConfig(encoders_at="motor", wire=DriveConfig(play_mm=1.5, play_rad=2.5, play_sd_share=0.5))
"""A robot whose encoders say where its motor is, and nothing else is known. Real plays: docs/concepts/robot.md."""
_JUMP_SHARE, _JUMPS = 0.1, np.array([2.0, 1.0])
"""Strays of a robot that is not known: it may slip, and its guiding catheter may back out."""
_UNKNOWN_JITTER = 0.05
"""What its plays are moved by, as a share: less is known of them."""
_KNOWN = 0.5
"""A play is unknown whose interval is wider than this share of what was likely before, or begins at the least."""


class Motion(NamedTuple):
    """What drives are to do in a period.

    Attributes:
        velocity: of the motors, mm/s and rad/s.
        done: whether the devices then are where they were wanted; else a play is taken up, and all devices rest.
    """

    velocity: Float[np.ndarray, "devices 2"]
    done: bool

    @property
    def commands(self) -> Proximals:
        """The velocities as pairs, one a device."""
        return tuple((translation, rotation) for translation, rotation in self.velocity.tolist())


class Drives:
    """The drives of a navigation, as they are believed to be.

    Attributes:
        lose: whether encoders sit in front of the play, at the motors.
        proximal: Δ, mm, and φ, rad, of each device where it most likely is.
        sd: standard deviations of these.
        at_rest: where the devices are once the motors have done what they were commanded before.
        commanded: what the drives were commanded last, mm/s and rad/s.
        unknown: whether nothing is known of the robot, and its encoders were found not to say where the devices are.
    """

    def __init__(
        self,
        robot: RobotConfig | None,
        start: Float[np.ndarray, "devices 2"],
        fastest: Float[np.ndarray, "devices 2"],
    ) -> None:
        """Begin at rest, at a place in the play that is not known.

        Args:
            robot: as it is known; one whose encoders sit at the devices if not given.
            start: where the devices are, and what the encoders read there, mm and rad.
            fastest: translation and rotation of each drive, mm/s and rad/s.
        """
        self._start, self._fastest, self._random = np.array(start, dtype=float), fastest, np.random.default_rng(0)
        self.commanded: Proximals = ()
        self.unknown = robot is UNKNOWN
        self._stray = (_JUMP_SHARE, _JUMPS) if self.unknown else (_STRAY_SHARE, _STRAYS)
        self._gap_jitter = _UNKNOWN_JITTER if self.unknown else _GAP_JITTER
        self._encoder, self._run_out = np.array(start, dtype=float), np.zeros(start.shape)
        self._sent = np.zeros(start.shape)
        self.proximal = self.at_rest = self._encoder
        self.sd = np.zeros(start.shape)
        self.lose = robot is not None and robot.encoders_at == "motor"
        if robot is not None and self.lose:
            shape, count = (_SAMPLES, *start.shape), len(start)
            self._robot, self._play = robot, robot.of_drives(count, "play_mm", "play_rad")
            gain = robot.of_drives(count, "gain_translation", "gain_rotation")
            spread = robot.of_drives(count, "gain_sd_translation", "gain_sd_rotation")
            self._gain = gain * (1 + spread * self._random.standard_normal(shape))
            spread = np.maximum(robot.of_drives(count, "play_sd_share"), _LEAST_SD)
            self._gap = self._play * np.maximum(1 + spread * self._random.standard_normal(shape), _LEAST_SHARE)
            self._ahead = self._gap * (self._random.random(shape) - 0.5)
            self._position = np.tile(self._encoder, (_SAMPLES, 1, 1))
            self._estimate()

    def begin(self, encoders: Proximals) -> None:
        """Take the first reading of the encoders, before anything has moved."""
        if not self.lose:
            self.proximal = self.at_rest = self._encoder = np.array(encoders, dtype=float)

    def follow(self, encoders: Proximals) -> None:
        """Take a reading of the encoders, a period after the last."""
        read = np.array(encoders, dtype=float)
        if not self.lose:
            self.proximal = self.at_rest = self._encoder = read
            return
        for place in (self._encoder + self._run_out, read):
            self._ahead, moved = through_play(self._ahead, (place - self._encoder) * self._gain, self._gap / 2)
            self._position = self._position + moved
            self._position += _CREEP_SHARE * np.abs(moved) * self._random.standard_normal(moved.shape)
            self._position[..., 0] = np.maximum(self._position[..., 0], 0.0)  # no drive goes farther back
            self._encoder = place
        self._estimate()

    def of_robot(self, robot: RobotConfig | None) -> Drives:
        """Return the drives of another robot at the start of the navigation, such as `UNKNOWN`."""
        return Drives(robot, self._start, self._fastest)

    @property
    def words(self) -> str:
        """What was found of an unknown robot, in words; empty for one that is known."""
        if not self.unknown:
            return ""
        low, high = np.quantile(self._gap[:, 0], (0.1, 0.9), axis=0)
        before = 2 * 1.28 * self._robot.wire.play_sd_share * self._play[0]
        units = "a play of {:.1f} to {:.1f} mm", "a play of {:.1f} to {:.1f} rad"
        known = (high - low <= _KNOWN * before) & (low > 1.5 * _LEAST_SHARE * self._play[0])
        found = [unit.format(*ends) for unit, *ends, sure in zip(units, low, high, known, strict=True) if sure]
        return ", ".join(["the wire is not where its encoder says", *(found or ["unknown play"])])

    def sent(self, velocity: Proximals) -> None:
        """Note what the drives are commanded until the next reading, mm/s and rad/s."""
        self.commanded = velocity
        if self.lose:
            commanded = np.zeros(self._sent.shape)
            commanded[: len(velocity)] = np.reshape(velocity, (-1, 2))
            commanded[~np.isfinite(commanded).all(axis=1)] = 0.0  # a drive stops then
            self._run_out = self._robot.run_out(self._sent)
            self._sent = np.clip(commanded, -self._fastest, self._fastest)

    def towards(self, wanted: Float[np.ndarray, "devices 2"], slower: Float[np.ndarray, "2"]) -> Motion:
        """Return how to bring the devices to where they are wanted, mm and rad, in a period.

        Where one has to turn back, its play is taken up first, and all devices rest.

        Args:
            wanted: Δ, mm, and φ, rad, of each device.
            slower: no device is to go faster than this behind a play that is taken up, mm/s and rad/s.
        """
        if not self.lose:
            return Motion((wanted - self._encoder) / DECISION_PERIOD_S, True)
        left = wanted - self.at_rest
        slack = self._slack(np.sign(left))
        turns = slack > _TAKEN_UP
        takes = turns & (np.abs(left) > _WORTH_IT)
        motor = np.where(takes, np.sign(left) * slack, 0.0)
        if not takes.any():
            motor = np.where(turns, 0.0, left + np.sign(left) * slack)
        velocity = motor / self._gain.mean(axis=0) / DECISION_PERIOD_S
        allowed = self._fastest if takes.any() else np.minimum(self._fastest, slower)
        made = np.clip(velocity, -allowed, allowed)
        return Motion(made, not takes.any() and np.array_equal(made, velocity))

    def nearest_turn(self, wanted: Float[np.ndarray, "devices"]) -> Float[np.ndarray, "devices"]:
        """Return rotations that are whole turns from wanted ones, rad, to which the motors go the shortest way."""
        if not self.lose:
            return wanted
        whole = wanted + 2 * np.pi * np.arange(-1, 2)[:, None]
        left = whole - self.at_rest[:, 1]
        cost = []
        for each in left:
            sign = np.sign(np.column_stack([np.zeros_like(each), each]))
            slack = self._slack(sign)[:, 1]
            unsure = (self._gap / 2 - sign * self._ahead_at_rest)[..., 1].std(axis=0) * (slack > _TAKEN_UP[1])
            cost.append(np.abs(each) + slack + unsure)
        return np.take_along_axis(whole, np.argmin(cost, axis=0)[None], axis=0)[0]

    def feel(self, device: int, force_n: float, *, pushed_n: float, valve: tuple[float, float]) -> None:
        """Weight the samples of a device by the force that its drive reads while the motor turns.

        Args:
            pushed_n: what the device ahead of the valve is believed to take of it, N.
            valve: friction of the introducer's valve, N, and its drag, N·s/mm.
        """
        speed, turning = self._sent[device].tolist()
        if not self.lose or abs(speed) < _MOVES_MM_S or abs(turning) > _TURNS_RAD_S:
            return
        left = self._gap[:, device, 0] / 2 - np.sign(speed) * self._ahead[:, device, 0]
        error = force_n - pushed_n - np.where(left < _TAKEN_UP[0], np.sign(speed) * valve[0] + speed * valve[1], 0.0)
        read_sd = self._robot.of_drives(len(self._sent), "load_sd_n")[device, 0]
        sd = np.hypot(read_sd, _FORCE_SD_N + _FORCE_SHARE * abs(pushed_n))
        score = np.log(np.exp(-0.5 * (error / sd) ** 2) + _LEAST_LIKELY)
        if np.ptp(score) > 0:
            self._draw(device, score)
            self._estimate()

    def samples(self, device: int) -> Float[np.ndarray, "samples 2"]:
        """Return where a device may be, mm and rad."""
        return self._position[:, device]

    def weigh(self, device: int, score: Float[np.ndarray, "samples"]) -> None:
        """Weight the samples of a device by their logarithmic likelihoods, up to a constant."""
        self._draw(device, score)
        moving, random = self._play[device] > 0, self._random
        gap, ahead, position = (each[:, device] for each in (self._gap, self._ahead, self._position))
        wider = 1 + self._gap_jitter * random.standard_normal(gap.shape)
        position = position + moving * _JITTER * random.standard_normal(position.shape)
        share, reach = self._stray
        stray = random.random(_SAMPLES) < share
        position[stray] += moving * reach * random.standard_normal((int(stray.sum()), 2))
        self._gap[:, device], self._ahead[:, device] = gap * wider, ahead * wider
        self._position[:, device] = position
        self._estimate()

    def _draw(self, device: int, score: Float[np.ndarray, "samples"]) -> None:
        """Draw the samples of a device anew, by their logarithmic likelihoods."""
        weight = np.exp(score - score.max())
        at = (np.arange(_SAMPLES) + self._random.random()) / _SAMPLES
        chosen = np.searchsorted(np.cumsum(weight) / weight.sum(), at).clip(0, _SAMPLES - 1)
        for each in (self._gap, self._ahead, self._position, self._gain):
            each[:, device] = each[chosen, device]

    def _estimate(self) -> None:
        self.proximal, _ = _estimated(self._position)
        low, high = np.quantile(self._position, (0.159, 0.841), axis=0)
        self.sd = (high - low) / 2
        driven = self._robot.run_out(self._sent) * self._gain
        self._ahead_at_rest, moved = through_play(self._ahead, driven, self._gap / 2)
        self.at_rest, self._near = _estimated(self._position + moved)

    def _slack(self, sign: Float[np.ndarray, "devices 2"]) -> Float[np.ndarray, "devices 2"]:
        """Return how far the motors go to a side before their devices follow, mm and rad."""
        left = self._gap / 2 - sign * self._ahead_at_rest
        return np.nanmedian(np.where(self._near, left, np.nan), axis=0)


def _estimated(
    position: Float[np.ndarray, "samples devices 2"],
) -> tuple[Float[np.ndarray, "devices 2"], Bool[np.ndarray, "samples devices 2"]]:
    """Return where devices most likely are, mm and rad, and the samples that are near."""
    near = np.abs(position - np.median(position, axis=0)) <= _NEAR
    return np.where(near, position, 0.0).sum(axis=0) / near.sum(axis=0), near
