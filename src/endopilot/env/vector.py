"""Navigation as a learning environment, many worlds at once: `NavigateVectorEnv`."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig
from endopilot.env.episodes import CONTROL_PERIOD_S, Episodes, NavigationState
from endopilot.env.exposures import CArms
from endopilot.env.observation import Measured, Observed, observe, observe_exposed, space
from endopilot.env.picture import Picture
from endopilot.env.reality import Reality
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import CORE, LadderVersion, in_catheter, reference_navigation, training_navigations
from endopilot.xray.fluoroscope import FluoroscopeConfig

TRANSLATION_MM_S, ROTATION_RAD_S = 12.0, 3.14
"""Velocities of an action of 1: the fastest of the random navigations of `ControlConfig`, and half a turn a second."""
Observations = Any
"""An array with a row a world, or a dictionary of such where images are observed."""

_MEASURED = ("encoder_inserted_length", "encoder_rotation", "load_n", "load_nmm")
"""What the info holds of what a robot measures of the wire."""
_PIXELS = (64, 128)
"""Least and most rows of an image."""


class NavigateVectorEnv(VectorEnv):
    """Bring a guidewire to a target in a vessel tree, in many worlds at once.

    ## Description

    A wire with a bent tip is driven from outside the body: it is pushed, pulled and turned at its proximal end, 7.5
    times a second. Its tip is to reach a place on the centerline of the tree. Friction delays and smooths what the tip
    does; which branch it enters at a fork depends on where the bend points. All worlds are stepped by one `Simulator`;
    `NavigateEnv` is this class with one world. A world's course does not depend on the others, to the last bit.

    It is no `NavigationLoop`: nobody decides every 0.5 s, all is observed as it truly is unless `observation` says
    otherwise, and the devices do as commanded unless `robot` names a robot with its latency and play. Then Δ and φ
    are observed as its encoders have them, and each episode draws a robot anew. It shares with the loop what a
    navigation is: start, rule of success, time and force limit (`Navigation`, `reached`, `is_safe`), how fast and how
    far a drive goes (`DriveLimits`), and what a C-arm shows (`Fluoroscope`, `XrayImager`).

    In `endopilot/NavigateXray-v0` seeing costs: encoders and loads of the drives are observed at every step, the tip
    only where X-ray is asked for.

    ## Action space

    `Box(-1, 1, (2,), float32)`, a row a world; values beyond ±1 are cut off.

    | index | action | unit of 1 |
    |---|---|---|
    | 0 | translation of the proximal end, positive inwards | 12 mm/s |
    | 1 | rotation of the proximal end about its axis | 3.14 rad/s |

    No wire is driven farther than 20 mm beyond the vessel's longest path, nor pulled out of the guiding catheter.

    With a catheter around the wire it is `Box(-1, 1, (4,), float32)`: 2 and 3 are the same of the catheter's proximal
    end, and so on for a second one. Each is driven by itself.

    With `observation="xray"` or `"image"` there is one number more, the last: above 0, an exposure of every view is
    taken at the end of the step.

    ## Observation space

    `Box(-10, 10, (31,), float32)`, a row a world; values beyond are cut off. The route runs along the centerline from
    the ostium to the target; its frame is its tangent and two normals carried along it without twist, at the place
    that is nearest to the tip along the tree. All values are true ones, as if X-ray were always on; with a robot,
    0 to 2 are its encoders'.

    | index | observation | unit of 1 |
    |---|---|---|
    | 0 | inserted length Δ | 100 mm |
    | 1, 2 | cosine and sine of the rotation φ | |
    | 3 | abscissa of the tip Δtip | 100 mm |
    | 4 | offset of the tip from the centerline γtip | the lumen's radius |
    | 5 | path length to the target along the tree, back out of a wrong branch first | 100 mm |
    | 6 | 1 on the route, 0 in a wrong branch | |
    | 7 | largest force of the wall on a node | the navigation's force limit |
    | 8 | time that is used up | the time limit |
    | 9 to 11 | direction of the tip in the route's frame | |
    | 12, 13 | offset of the tip from the route along its normals | the lumen's radius |
    | 14 to 25 | places of the route 3, 6, 12 and 24 mm ahead, in its frame | that distance |
    | 26 to 29 | lumen radius at these places | 2 mm |
    | 30 | slack Δ − Δtip | 10 mm |

    With a catheter it is `Box(-10, 10, (39,), float32)`, with eight more for each:

    | index | observation | unit of 1 |
    |---|---|---|
    | 31 | inserted length of the catheter | 100 mm |
    | 32, 33 | cosine and sine of its rotation | |
    | 34 | abscissa of its tip | 100 mm |
    | 35 | offset of its tip from the centerline | the lumen's radius |
    | 36 | path length from its tip to the target | 100 mm |
    | 37 | 1 where its tip is on the route, 0 in a wrong branch | |
    | 38 | its slack | 10 mm |

    With `observation="xray"` it is `Box(-10, 10, (32,), float32)`: what a robot measures, and the last exposure, which
    has the C-arm's errors of detection (`FluoroscopeConfig`).

    | index | observation | unit of 1 |
    |---|---|---|
    | 0 | Δ by the encoder | 100 mm |
    | 1, 2 | cosine and sine of φ by the encoder | |
    | 3, 4 | force and torque of the drive | 0.5 N, 0.5 N·mm |
    | 5 | time that is used up | the time limit |
    | 6 | time since the last exposure | 10 s |
    | 7, 8 | what Δ and φ have changed since, by the encoder | 10 mm, π |
    | 9, 10 | at that exposure: abscissa of the tip, offset from the centerline | 100 mm, the lumen's radius |
    | 11, 12 | path length to the target, 1 on the route | 100 mm |
    | 13, 14 | offset of the tip from the route along its normals | the lumen's radius |
    | 15 to 26 | places of the route 3, 6, 12 and 24 mm ahead of it, in the route's frame | that distance |
    | 27 to 30 | lumen radius at these places | 2 mm |
    | 31 | slack: Δ by the encoder less the abscissa | 10 mm |

    For each catheter five more follow, which are as 0 to 4.

    With `observation="image"` it is a dictionary: `measured` is 0 to 8 of these and what follows for catheters, and
    `image` a `Box(0, 255, (views, pixels, pixels), uint8)`, the X-ray images of the last exposure. The vessel is laid
    under them as a roadmap, light grey; the target is a white square of 3 × 3 pixels, the wire dark. An image shows the
    whole vessel. `c_arm=FluoroscopeConfig(biplane=False)` takes one view in place of two.

    ## Reward

    The sum of

    | what | reward |
    |---|---|
    | every mm by which the path to the target has become shorter (longer: negative) | 0.1 |
    | every step | −0.01 |
    | every step that ends with a force of the wall beyond the navigation's limit | −0.1 |
    | the target | 5 |
    | every exposure, except the one at the start | −0.05 |

    Where the catheter's tip is to go to the target, every mm counts that the wire's tip or the catheter's comes nearer.

    ## Start

    Inserted lengths as the navigation says; the wire's rotation is drawn evenly over a full turn, a catheter's is 0.
    Where seeing costs, an exposure shows the start. World i of a vector environment that is reset with seed s draws
    what a single environment that is reset with seed s + i draws.

    ## End of an episode

    - *Termination:* the tip has reached the target (in its branch, within 2 mm along the centerline), or the world has
      become invalid (the rod core failed; it then stays as it was). Where the catheter's tip is to go there, the wire's
      may not lie more than 2 mm behind it.
    - *Truncation:* the navigation's time is over.

    A vector environment resets an ended world at the next step (`AutoresetMode.NEXT_STEP`: that step's action is
    ignored, its reward 0), or never (`AutoresetMode.DISABLED`: call `reset` with `options={"reset_mask": ...}`).

    ## Info

    Arrays with an entry a world, each with its mask `_name`: `contact_force_max` (N, the largest force of the wall on
    one node at the end of the step), `valid`, `success`, `safe` (no force beyond the limit so far), `distance_mm` (path
    length to the target from the tip that is to arrive), `inserted_length` (mm), `rotation` (rad), `tip_abscissa` (mm),
    `tip_offset` (mm), `tip_branch`, `time_s`; and for each catheter `catheter_1_inserted_length`,
    `catheter_1_rotation`, `catheter_1_tip_abscissa`, `catheter_1_tip_offset`, `catheter_1_tip_branch`. With a robot
    also what it measures of the wire, `encoder_inserted_length`, `encoder_rotation`, `load_n`, `load_nmm`. Where seeing
    costs also `exposed` (whether the observation holds a new exposure) and `exposures` (in the episode so far). In a
    single environment they are numbers.

    ## Arguments

    `endopilot/Navigate-v0`: 15 mm into the posterior descending artery of the reference right coronary artery (patient
    0 of the textbook atlas with seed 0). `endopilot/NavigateCoaxial-v0`: the same place, to which the tip of a
    microcatheter (`microcatheter-1.7f`) is to be brought over the wire. `endopilot/NavigateXray-v0`: the first with
    `observation="xray"`, which any of them takes. The others are the tasks of the ladder, of its version 2 as
    `endopilot/Crux-v2` (and `endopilot/Follow-v2`, of wire and catheter), of its version 1 as `endopilot/Crux-v0`, in
    patients of their own, which are not those that the ladder is scored on; world i has patient (`patient` + i) modulo
    `patients`. `version` takes a folder of tasks of your own as `endopilot ladder --version` does. With `catheter` a
    task is to be done by the tip of that catheter. Or give `navigations` of your own. With `motion` the vessels move;
    positions are those in the vessel as CT shows it, and every episode begins at the phase of the CT; an exposure takes
    off what `Navigation.known_motion` says.

    `world` says where reality differs from what is given: a `World`, its name or file, or several, which the worlds
    have in turn. Where a `World` leaves something to chance, the number of the world is the seed. With "random" each
    episode draws friction (half to twice what is given), ostium (±2.5 mm) and registration (±1 mm along each axis).
    `robot` is one robot or several, likewise. A random one has plays of up to 2.6 mm and 0.9 turns, gains of 0.95 to
    1.05, a latency of up to 0.1 s, and encoders at its motors or on the devices.

    ## Version history

    - v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012, as Gymnasium declares it
        "render_modes": ["rgb_array"],
        "render_fps": 1.0 / CONTROL_PERIOD_S,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
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
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        motion: Motion | None = None,
        config: SimulatorConfig = CORE,
        render_mode: str | None = None,
    ) -> None:
        """Lay the wires out; `reset` starts the first episodes.

        Args:
            num_envs: number of worlds.
            navigations: one for all worlds, or several, of which world i has number i modulo their number.
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
            autoreset_mode: whether an ended world is reset at the next step.
            motion: how heart and breath move all vessels and their guiding catheters; they lie still if not given.
            config: settings of the rod core.
            render_mode: "rgb_array" lets `render` return pictures.

        Raises:
            InputError: no world, no such task or catheter, a catheter for navigations of one's own; a device that is
                slower than an action of 1 or does not fit; navigations with different catheters; no such robot or
                world, or worlds that cannot be stepped together.
        """
        if num_envs < 1:
            raise InputError(f"num_envs: {num_envs}; give at least 1")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode: {render_mode!r}; give 'rgb_array' or None")
        if autoreset_mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            raise InputError(f"autoreset_mode: {autoreset_mode}; give AutoresetMode.NEXT_STEP or DISABLED")
        if observation not in get_args(Observed):
            raise InputError(f"observation: {observation!r}; choose from {', '.join(get_args(Observed))}")
        if not _PIXELS[0] <= pixels <= _PIXELS[1]:
            raise InputError(f"pixels: {pixels}; give {_PIXELS[0]} to {_PIXELS[1]}")
        if navigations is None:
            ours = task or version != 1
            navigations = training_navigations(task, patient, patients, version) if ours else [reference_navigation()]
            navigations = in_catheter(navigations, catheter) if catheter else navigations
        elif catheter:
            raise InputError(f"catheter: {catheter}; give it to the navigations")
        given = [navigations] if isinstance(navigations, Navigation) else list(navigations)
        if robot is None and observation != "state":
            robot = RobotConfig()
        self._given = {
            "navigations": [given[number % len(given)] for number in range(num_envs)],
            "observation": observation,
            "pixels": pixels if observation == "image" else 0,
            "c_arm": c_arm or FluoroscopeConfig(),
            "autoreset_mode": autoreset_mode,
            "reality": {"world": world, "robot": robot, "motion": motion, "config": config},
        }
        self._prepare(**self._given)
        self.render_mode = render_mode

    def _prepare(
        self,
        navigations: list[Navigation],
        observation: Observed,
        pixels: int,
        c_arm: FluoroscopeConfig,
        autoreset_mode: AutoresetMode,
        reality: dict[str, Any],
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
        self.metadata = type(self).metadata | {"autoreset_mode": autoreset_mode}
        self._pictures: dict[int, Picture] = {}
        self.num_envs = count
        self._drives = len(first.devices)
        self._fastest = np.tile([TRANSLATION_MM_S, ROTATION_RAD_S], self._drives)
        self.single_action_space = Box(-1.0, 1.0, (2 * self._drives + (observation != "state"),), np.float32)
        self.single_observation_space = space(observation, len(first.catheters), (1 + c_arm.biplane, pixels, pixels))
        self.action_space = batch_space(self.single_action_space, count)
        self.observation_space = batch_space(self.single_observation_space, count)
        self._reality = Reality(navigations, **reality)
        self._simulator = self._reality.simulator
        self._episodes = Episodes(navigations)
        self._c_arms: CArms | None = None
        if observation != "state":
            self._c_arms = CArms(navigations, self._simulator, config=c_arm, pixels=pixels)
        self._everyone = np.ones(count, dtype=bool)
        self._generators = [seeding.np_random()[0] for _ in range(count)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`.

        Args:
            seed: world i draws from seed + i, or from its own; without one the generators go on.
            options: `reset_mask`, a boolean for each world.

        Returns:
            Observations and info of all worlds.
        """
        mask = self._everyone if not options else np.asarray(options.get("reset_mask", self._everyone), dtype=bool)
        if mask.shape != (self.num_envs,):
            raise InputError(f"reset_mask: shape {mask.shape}; give a boolean for each of the {self.num_envs} worlds")
        if seed is not None:
            seeds = [seed + world for world in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
            for world in np.flatnonzero(mask).tolist():
                self._generators[world] = seeding.np_random(seeds[world])[0]
        self._begin(mask)
        now = Measured.current(self._simulator, self._reality.encoders)
        distances = self._episodes.routes.distance(now.tip)
        return self._observe(now, distances), self._infos(now, mask)

    def step(
        self, actions: ArrayLike
    ) -> tuple[
        Observations,
        Float[np.ndarray, "worlds"],
        Bool[np.ndarray, "worlds"],
        Bool[np.ndarray, "worlds"],
        dict[str, Any],
    ]:
        """Drive every world for a control period.

        Args:
            actions: a row a world.

        Returns:
            Observations, rewards, terminations, truncations and info, as the class says.

        Raises:
            InputError: actions of another shape, or not finite; no world is moved then.
        """
        control = np.array(actions, dtype=float)
        if control.shape != self.action_space.shape or not np.isfinite(control).all():
            raise InputError(f"actions: shape {control.shape}; give finite numbers of shape {self.action_space.shape}")
        fresh = self._episodes.ended & (self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP)
        expose = (control[:, -1] > 0.0) & ~fresh & (self._c_arms is not None)
        control = np.minimum(np.maximum(control[:, : 2 * self._drives], -1.0), 1.0) * self._fastest
        control[fresh] = 0.0
        control = control.reshape(self.num_envs, self._drives, 2)
        step = self._reality.drive(control, CONTROL_PERIOD_S, self._episodes.time_s)
        now = Measured.after(step, self._simulator, self._reality.encoders)
        self._episodes.steps += ~fresh
        self._expose(expose, self._reality.encoders)
        if fresh.any():
            self._begin(fresh)
            now = Measured.current(self._simulator, self._reality.encoders)
        distances = self._episodes.routes.distance(now.tip)
        judged = self._episodes.judge(now, distances, fresh, expose)
        return self._observe(now, distances), *judged, self._infos(now, expose | fresh)

    def _expose(self, mask: Bool[np.ndarray, "worlds"], encoders: Float[np.ndarray, "worlds devices 2"]) -> None:
        """Take exposures in the worlds of a mask."""
        if self._c_arms is not None:
            registration_mm = self._reality.drawn.registration_mm
            self._c_arms.expose(mask, self._simulator, encoders, registration_mm, self._episodes.time_s)

    def _observe(self, now: Measured, distances: Float[np.ndarray, "worlds devices"]) -> Observations:
        episodes = self._episodes
        if self._c_arms is not None:
            exposed, images = self._c_arms.exposed, self._given["observation"] == "image"
            routes = None if images else episodes.routes
            measured = observe_exposed(self._reality.proximal, exposed, routes, episodes.time_s, episodes.time_share)
            return {"image": exposed.image.copy(), "measured": measured} if images else measured
        return observe(now, episodes.routes, distances, episodes.force_limit_n, episodes.time_share)

    def draw_from(self, *generators: np.random.Generator) -> None:
        """Let each world draw its starts from a generator that the caller holds."""
        self._generators = list(generators)

    def _begin(self, mask: Bool[np.ndarray, "worlds"]) -> None:
        """Start an episode in the worlds of a mask."""
        self._reality.begin(mask, self._generators)
        self._episodes.begin(mask, self._simulator.project())
        if self._c_arms is not None:
            self._c_arms.begin(mask, self._generators)
            self._expose(mask, self._reality.encoders)

    def _infos(self, now: Measured, exposed: Bool[np.ndarray, "worlds"]) -> dict[str, Any]:
        infos = self._episodes.infos(now)
        if (readings := self._reality.drawn.readings) is not None:
            infos |= zip(_MEASURED, np.moveaxis(readings[:, 0], -1, 0), strict=True)
        if self._c_arms is not None:
            infos |= {"exposed": exposed, "exposures": self._c_arms.exposed.count.copy()}
        return infos | {f"_{name}": self._everyone for name in infos}

    @property
    def state(self) -> NavigationState:
        """All that the future depends on, to be kept and given to `set_state`."""
        return NavigationState(
            self._simulator.state,
            **self._episodes.arrays(),
            generators=tuple(dict(copy.deepcopy(generator.bit_generator.state)) for generator in self._generators),
            drawn=copy.deepcopy(self._reality.drawn),
            exposed=None if self._c_arms is None else copy.deepcopy(self._c_arms.exposed),
        )

    def set_state(self, state: NavigationState) -> None:
        """Go back to a state, bit by bit.

        Raises:
            InputError: it is that of other navigations or settings.
        """
        self._simulator.set_state(state.simulator)
        self._episodes.set_arrays(state.steps, state.distance, state.safe, state.ended)
        self._reality.drawn = copy.deepcopy(state.drawn)
        if self._c_arms is not None:
            self._c_arms.exposed = copy.deepcopy(state.exposed)
        for generator, kept in zip(self._generators, state.generators, strict=True):
            generator.bit_generator.state = copy.deepcopy(kept)

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
        self._prepare(**self._given)
        self.set_state(kept["state"])
        self.spec, self.render_mode = kept["spec"], kept["render_mode"]
