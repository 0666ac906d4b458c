"""Navigation as a learning environment, many worlds at once: `NavigateVectorEnv`."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

from endopilot.anatomy.io import read_anatomy
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.env.exposures import CArms, Picture
from endopilot.env.observation import (
    CONTROL_PERIOD_S,
    Episodes,
    Measured,
    NavigationState,
    Observed,
    observe,
    observe_exposed,
    space,
)
from endopilot.env.reality import Reality
from endopilot.errors import InputError
from endopilot.settings import Within, public
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import Step
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.targets import Place
from endopilot.tasks.task import CORE, LadderVersion, in_catheter, reference_navigation, training_navigations
from endopilot.types import Anatomy
from endopilot.xray.fluoroscope import FluoroscopeConfig

TRANSLATION_MM_S, ROTATION_RAD_S = 12.0, 3.14
"""Velocities of an action of 1: the fastest of the random navigations of `ControlConfig`, and half a turn a second."""
Observations = Any
"""An array with a row a world, or a dictionary of such where images are observed."""

_MEASURED = ("encoder_inserted_length", "encoder_rotation", "load_n", "load_nmm")
"""What the info holds of what a robot measures of the wire."""
_CHANGING = ("steps", "distance", "safe", "ended")
"""What of `Episodes` changes as they go on."""
_PIXELS = (64, 128)
"""Least and most rows of an image."""


def refuse_options(options: dict[str, Any] | None, *known: str) -> None:
    """Raise `InputError` for an option that `reset` does not understand."""
    for name in set(options or {}) - set(known):
        raise InputError(f"options: {name!r}; reset takes {' and '.join(known) or 'none'}, all else is given to make")


def of_world(observations: Observations, world: int) -> Observations:
    """Return the observation of one world."""
    if isinstance(observations, dict):
        return {name: values[world] for name, values in observations.items()}
    return observations[world]


class NavigateVectorEnv(VectorEnv):
    """Bring a guidewire to a target in a vessel tree, in many worlds at once.

    A wire with a bent tip is pushed, pulled and turned at its proximal end, every `period_s`. All worlds are stepped by
    one `Simulator`; a world's course does not depend on the others, to the last bit. What goes in and comes out,
    reward, start, ends, info and arguments are specified in docs/concepts/environments.md.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012, as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 1.0 / CONTROL_PERIOD_S,
    }

    @public
    def __init__(
        self,
        num_envs: int = 1,
        anatomy: Anatomy | str | Path | None = None,
        target: str | Place | None = None,
        *,
        device: Wire | Stack | str | Path | None = None,
        navigations: Navigation | Sequence[Navigation] | None = None,
        task: str | None = None,
        patient: int = 0,
        patients: int = 1,
        catheter: str | None = None,
        version: LadderVersion = 1,
        observation: Observed = "state",
        pixels: int = 64,
        c_arm: FluoroscopeConfig | None = None,
        world: World | str | Path | Sequence[World | str | Path] | None = None,
        robot: RobotConfig | str | Path | Sequence[RobotConfig | str | Path] | None = None,
        autoreset_mode: AutoresetMode | Literal["NextStep", "SameStep", "Disabled"] = AutoresetMode.NEXT_STEP,
        motion: Motion | None = None,
        config: SimulatorConfig = CORE,
        render_mode: Literal["rgb_array"] | None = None,
        period_s: Annotated[float, Within(0.0, 2.0, above_low=True)] = CONTROL_PERIOD_S,
        max_episode_steps: int | None = None,
    ) -> None:
        """Lay the wires out; `reset` starts the first episodes.

        Args:
            num_envs: number of worlds.
            anatomy: a vessel of your own, or its folder.
            target: where the tip is to go in it, as `Anatomy.target` does: a section such as "LAD", or a point.
            device: the wire in it, or a stack; its name or its YAML file; `workhorse-014` if not given.
            navigations: in place of these, one for all worlds, or several, of which world i has number i modulo their
                number.
            task: in place of them, the name of a task of the ladder.
            patient: the first of its training patients.
            patients: number of its training patients that the worlds have.
            catheter: name of a catheter around the wire, or a YAML file; its tip is to arrive then.
            version: of the ladder that the task is of, or a folder of tasks of one's own. Without a task the worlds
                have those of the folder in turn.
            observation: what is observed.
            pixels: rows and columns of an image, 64 to 128.
            c_arm: its views, one or two, and errors of detection.
            world: what reality is where it differs from the navigations, or its name or YAML file; or several, of which
                world i has number i modulo their number; or "random".
            robot: what drives, likewise; the devices do as commanded if not given, or where X-ray shows the tip,
                robots are as assumed.
            autoreset_mode: whether an ended world is reset at the next step, in the same step, or not by itself.
            motion: how heart and breath move all vessels and their guiding catheters; they lie still if not given.
            config: settings of the rod core.
            render_mode: "rgb_array" lets `render` return pictures.
            period_s: time between two actions, s; the ladder's policies decide every 0.5 s.
            max_episode_steps: of the registered environment, which Gymnasium hands on; navigations of your own may take
                fewer steps.

        Raises:
            InputError: no world, no such task, target, device or catheter, or one of these for navigations that have
                theirs; a device that is slower than an action of 1 or does not fit; navigations with different
                catheters; no such robot or world, or worlds that cannot be stepped together.
        """
        if num_envs < 1:
            raise InputError(f"num_envs: {num_envs}; give at least 1")
        if not _PIXELS[0] <= pixels <= _PIXELS[1]:
            raise InputError(f"pixels: {pixels}; give {_PIXELS[0]} to {_PIXELS[1]}")
        if (anatomy is None) != (target is None):
            raise InputError("anatomy, target: give both, such as NavigateEnv(anatomy, target='LAD'), or neither")
        if device is not None and anatomy is None:
            raise InputError("device: give it with anatomy and target, or to the navigations")
        if catheter is not None and navigations is not None:
            raise InputError(f"catheter: {catheter}; give it to the navigations")
        if anatomy is not None and target is not None:
            vessel = anatomy if isinstance(anatomy, Anatomy) else read_anatomy(anatomy)
            stack, place = Stack.of(device or "workhorse-014"), vessel.target(target)
            given = [Navigation(anatomy=vessel, device=stack.wire, target=place, catheters=stack.catheters)]
        elif navigations is None:
            ours = task or version != 1
            given = training_navigations(task, patient, patients, version) if ours else [reference_navigation()]
        else:
            given = [navigations] if isinstance(navigations, Navigation) else list(navigations)
        given = in_catheter(given, catheter) if catheter else given
        longest = max((navigation.periods(period_s) for navigation in given), default=0)
        if max_episode_steps is not None and longest > max_episode_steps:
            raise InputError(
                f"navigations: take up to {longest} steps, and the registered environment {max_episode_steps}; make "
                "NavigateEnv(navigations=...) in its place, or give make_vec max_episode_steps"
            )
        if robot is None and observation != "state":
            robot = RobotConfig()
        every = [given[number % len(given)] for number in range(num_envs)]
        arms = {"config": c_arm or FluoroscopeConfig(), "pixels": pixels if observation == "image" else 0}
        reality = {"world": world, "robot": robot, "motion": motion, "config": config}
        self._given = (every, observation, AutoresetMode(autoreset_mode), arms, reality, period_s)
        self._prepare(*self._given)
        self.render_mode = render_mode

    def _prepare(
        self,
        navigations: list[Navigation],
        observation: Observed,
        autoreset_mode: AutoresetMode,
        arms: dict[str, Any],
        reality: dict[str, Any],
        period_s: float,
    ) -> None:
        first = navigations[0]
        if any((other.catheters, other.arrives) != (first.catheters, first.arrives) for other in navigations):
            raise InputError("navigations: differ in catheters, or in which tip is to arrive; give all the same")
        for device in (device for navigation in navigations for device in navigation.devices):
            speed, spin = DriveLimits.of(device).fastest
            if speed < TRANSLATION_MM_S or spin < ROTATION_RAD_S:
                raise InputError(
                    f"device {device.name}: max_velocity_mm_s = {speed:g}, max_rotation_rad_s = {spin:g}; "
                    f"an action of 1 is {TRANSLATION_MM_S:g} mm/s and {ROTATION_RAD_S:g} rad/s; give a faster device"
                )
        count = len(navigations)
        self.navigations = tuple(navigations)
        self.metadata = type(self).metadata | {"autoreset_mode": autoreset_mode, "render_fps": 1.0 / period_s}
        self._pictures: dict[int, Picture] = {}
        self.num_envs = count
        self._drives = len(first.devices)
        self._fastest = np.tile([TRANSLATION_MM_S, ROTATION_RAD_S], self._drives)
        self.single_action_space = Box(-1.0, 1.0, (2 * self._drives + (observation != "state"),), np.float32)
        images = (1 + arms["config"].biplane, arms["pixels"], arms["pixels"])
        self.single_observation_space = space(observation, len(first.catheters), images)
        self.action_space = batch_space(self.single_action_space, count)
        self.observation_space = batch_space(self.single_observation_space, count)
        self._reality = Reality(navigations, **reality)
        self._simulator = self._reality.simulator
        self._episodes = Episodes(navigations, period_s)
        self._c_arms = None if observation == "state" else CArms(navigations, self._simulator, **arms)
        self._everyone = np.ones(count, dtype=bool)
        self._generators = [seeding.np_random()[0] for _ in range(count)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`, a boolean for each.

        World i draws from seed + i, or from its own; without a seed the generators go on. InputError for another
        option, or a mask of another shape.
        """
        refuse_options(options, "reset_mask")
        mask = np.asarray((options or {}).get("reset_mask", self._everyone), dtype=bool)
        if mask.shape != (self.num_envs,):
            raise InputError(f"reset_mask: shape {mask.shape}; give a boolean for each of the {self.num_envs} worlds")
        if seed is not None:
            seeds = [seed + world for world in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
            for world in np.flatnonzero(mask).tolist():
                if seeds[world] is not None:
                    self._generators[world] = seeding.np_random(seeds[world])[0]
        self._begin(mask)
        now = self._now()
        return self._observe(now), self._infos(now, mask)

    def step(
        self, actions: ArrayLike
    ) -> tuple[
        Observations,
        Float[np.ndarray, "worlds"],
        Bool[np.ndarray, "worlds"],
        Bool[np.ndarray, "worlds"],
        dict[str, Any],
    ]:
        """Drive every world for a control period, by a row of actions each. `ResetNeeded` is raised where a world has
        not been reset, or its episode has ended and nothing resets it by itself, and InputError for actions of another
        shape or not finite; no world is moved then."""
        mode, episodes = self.metadata["autoreset_mode"], self._episodes
        over = (episodes.steps < 0) | (episodes.ended & (mode is AutoresetMode.DISABLED))
        if over.any():
            worlds = ", ".join(map(str, np.flatnonzero(over)))
            raise ResetNeeded(f"Cannot call step() before reset(): no episode goes on in worlds {worlds}")
        control = np.array(actions, dtype=float)
        if control.shape != self.action_space.shape or not np.isfinite(control).all():
            raise InputError(f"actions: shape {control.shape}; give finite numbers of shape {self.action_space.shape}")
        fresh = episodes.ended & (mode is AutoresetMode.NEXT_STEP)
        expose = (control[:, -1] > 0.0) & ~fresh & (self._c_arms is not None)
        control = np.minimum(np.maximum(control[:, : 2 * self._drives], -1.0), 1.0) * self._fastest
        control[fresh] = 0.0
        control = control.reshape(self.num_envs, self._drives, 2)
        step = self._reality.drive(control, episodes.period_s, episodes.time_s)
        now = self._now(step)
        episodes.steps += ~fresh
        self._expose(expose)
        if fresh.any():
            self._begin(fresh)
            now = self._now()
        judged = episodes.judge(now, fresh, expose)
        observations, infos = self._observe(now), self._infos(now, expose | fresh)
        if mode is AutoresetMode.SAME_STEP and episodes.ended.any():
            ended, last = episodes.ended.copy(), np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(ended).tolist():
                last[world] = of_world(observations, world)
            final = {name: ended if name.startswith("_") else values for name, values in infos.items()}
            self._begin(ended)
            now = self._now()
            observations, infos = self._observe(now), self._infos(now, expose | ended)
            infos |= {"final_obs": last, "_final_obs": ended, "final_info": final, "_final_info": ended}
        return observations, *judged, infos

    def _now(self, step: Step | None = None) -> Measured:
        simulator, tip = self._simulator, self._simulator.project()
        force = simulator.contacts.max(axis=1) if step is None else step.contact_force_max
        distance_mm = self._episodes.routes.distance(tip)
        return Measured(step or simulator, force, tip, distance_mm, self._reality.encoders)

    def _expose(self, mask: Bool[np.ndarray, "worlds"]) -> None:
        if self._c_arms is not None:
            encoders, registration_mm = self._reality.encoders, self._reality.drawn.registration_mm
            self._c_arms.expose(mask, self._simulator, encoders, registration_mm, self._episodes.time_s)

    def _observe(self, now: Measured) -> Observations:
        episodes, share = self._episodes, self._episodes.time_s / self._episodes.seconds
        if self._c_arms is not None:
            exposed, images = self._c_arms.exposed, isinstance(self.single_observation_space, Dict)
            routes = None if images else episodes.routes
            measured = observe_exposed(self._reality.proximal, exposed, routes, episodes.time_s, share)
            return {"image": exposed.image.copy(), "measured": measured} if images else measured
        return observe(now, episodes.routes, episodes.force_limit_n, share)

    def draw_from(self, *generators: np.random.Generator) -> None:
        """Let each world draw its starts from a generator that the caller holds."""
        self._generators = list(generators)

    def _begin(self, mask: Bool[np.ndarray, "worlds"]) -> None:
        self._reality.begin(mask, self._generators)
        self._episodes.begin(mask, self._simulator.project())
        if self._c_arms is not None:
            self._c_arms.begin(mask, self._generators)
            self._expose(mask)

    def _infos(self, now: Measured, exposed: Bool[np.ndarray, "worlds"]) -> dict[str, Any]:
        infos = self._episodes.infos(now)
        if (readings := self._reality.drawn.readings) is not None:
            infos |= zip(_MEASURED, readings[:, 0].T.copy(), strict=True)
        if self._c_arms is not None:
            infos |= {"exposed": exposed, "exposures": self._c_arms.exposed.count.copy()}
        return infos | {f"_{name}": self._everyone for name in infos}

    @property
    def state(self) -> NavigationState:
        """All that the future depends on, to be kept and given to `set_state`."""
        kept = {"episodes": {name: getattr(self._episodes, name) for name in _CHANGING}, "drawn": self._reality.drawn}
        kept["generators"] = [generator.bit_generator.state for generator in self._generators]
        kept["exposed"] = self._c_arms and self._c_arms.exposed
        return NavigationState(self._simulator.state, copy.deepcopy(kept))

    def set_state(self, state: NavigationState) -> None:
        """Go back to a state, bit by bit; InputError for that of other navigations or settings."""
        self._simulator.set_state(state.simulator)
        kept = copy.deepcopy(state.kept)
        self._reality.drawn = kept["drawn"]
        vars(self._episodes).update(kept["episodes"])
        if self._c_arms is not None:
            self._c_arms.exposed = kept["exposed"]
        for generator, before in zip(self._generators, kept["generators"], strict=True):
            generator.bit_generator.state = before

    def render(self) -> tuple[UInt8[np.ndarray, "256 256 3"], ...] | None:
        """Return a picture of each world with `render_mode="rgb_array"`: vessel, target, wire and catheters."""
        if self.render_mode is None:
            return None
        for navigation in self.navigations:
            if id(navigation) not in self._pictures:
                self._pictures[id(navigation)] = Picture(navigation)
        pictures = (self._pictures[id(navigation)] for navigation in self.navigations)
        return tuple(picture.of(self._simulator, world) for world, picture in enumerate(pictures))

    @property
    def simulator(self) -> Simulator:
        """The worlds, for pictures of the wires; stepping it bypasses the environment."""
        return self._simulator

    def __getstate__(self) -> dict[str, Any]:
        """Return what `__setstate__` makes the environment of again; the rod core itself cannot be pickled."""
        return {"given": self._given, "state": self.state, "spec": self.spec, "render_mode": self.render_mode}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self._given = kept["given"]
        self._prepare(*self._given)
        self.set_state(kept["state"])
        self.spec, self.render_mode = kept["spec"], kept["render_mode"]
