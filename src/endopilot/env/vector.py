"""Navigation as a learning environment, many worlds at once: `NavigateVectorEnv`."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from endopilot.env import observation
from endopilot.env.observation import Measured, observe
from endopilot.env.route_tables import RouteTables
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.drive_limits import far_end_mm, within_travel
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulatorState
from endopilot.tasks.navigation import Navigation, reached
from endopilot.tasks.task import CORE, reference_navigation, training_navigations

CONTROL_PERIOD_S = 2 / 15
"""Time between two actions, s: fluoroscopy's usual 7.5 frames a second."""
TRANSLATION_MM_S, ROTATION_RAD_S = 12.0, 3.14
"""Velocities of an action of 1: the fastest of the random navigations of `ControlConfig`, and half a turn a second."""
_FASTEST = np.array([TRANSLATION_MM_S, ROTATION_RAD_S])
PROGRESS_REWARD, STEP_REWARD, FORCE_REWARD, SUCCESS_REWARD = 0.1, -0.01, -0.1, 5.0
"""A mm nearer to the target, every step, every step with too large a force, and the target."""

_MASKS = tuple(
    f"_{name}"
    for name in (
        *("contact_force_max", "valid", "success", "safe", "distance_mm", "inserted_length", "rotation"),
        *("tip_abscissa", "tip_offset", "tip_branch", "time_s"),
    )
)
"""Names of the masks in the info of a vector environment."""


@dataclass(frozen=True, eq=False)
class NavigationState:
    """All that the future of a `NavigateVectorEnv` depends on; it can be pickled and copied.

    Attributes:
        simulator: the worlds.
        steps: steps of each world since its reset.
        distance: path length from each tip to its target at the last step, mm.
        safe: worlds whose force has not been too large since their reset.
        ended: worlds whose episode has ended, which the next step resets.
        generators: state of each world's random generator.
    """

    simulator: SimulatorState
    steps: np.ndarray
    distance: np.ndarray
    safe: np.ndarray
    ended: np.ndarray
    generators: tuple[dict[str, Any], ...]


class NavigateVectorEnv(VectorEnv):
    """Bring a guidewire to a target in a vessel tree, in many worlds at once.

    ## Description

    A wire with a bent tip is driven from outside the body: it is pushed, pulled and turned at its proximal end, 7.5
    times a second. Its tip is to reach a place on the centerline of the tree. Friction delays and smooths what the tip
    does; which branch it enters at a fork depends on where the bend points. All worlds are stepped by one `Simulator`;
    `NavigateEnv` is this class with one world. A world's course does not depend on the others, to the last bit.

    ## Action space

    `Box(-1, 1, (2,), float32)`, a row a world; values beyond ±1 are cut off.

    | index | action | unit of 1 |
    |---|---|---|
    | 0 | translation of the proximal end, positive inwards | 12 mm/s |
    | 1 | rotation of the proximal end about its axis | 3.14 rad/s |

    No wire is driven farther than 20 mm beyond the vessel's longest path, nor pulled out of the catheter.

    ## Observation space

    `Box(-10, 10, (31,), float32)`, a row a world; values beyond are cut off. The route runs along the centerline from
    the ostium to the target; its frame is its tangent and two normals carried along it without twist, at the place
    that is nearest to the tip along the tree. All values are true ones, as if X-ray were always on.

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

    ## Reward

    The sum of

    | what | reward |
    |---|---|
    | every mm by which the path to the target has become shorter (longer: negative) | 0.1 |
    | every step | −0.01 |
    | every step that ends with a force of the wall beyond the navigation's limit | −0.1 |
    | the target | 5 |

    ## Start

    Inserted length as the navigation says; the rotation is drawn evenly over a full turn. World i of a vector
    environment that is reset with seed s draws what a single environment that is reset with seed s + i draws.

    ## End of an episode

    - *Termination:* the tip has reached the target (in its branch, within 2 mm along the centerline), or the world has
      become invalid (the rod core failed; it then stays as it was).
    - *Truncation:* the navigation's time is over.

    A vector environment resets an ended world at the next step (`AutoresetMode.NEXT_STEP`: that step's action is
    ignored, its reward 0), or never (`AutoresetMode.DISABLED`: call `reset` with `options={"reset_mask": ...}`).

    ## Info

    Arrays with an entry a world, each with its mask `_name`: `contact_force_max` (N, the largest force of the wall on
    one node at the end of the step), `valid`, `success`, `safe` (no force beyond the limit so far), `distance_mm` (path
    length to the target), `inserted_length` (mm), `rotation` (rad), `tip_abscissa` (mm), `tip_offset` (mm),
    `tip_branch`, `time_s`. In a single environment they are numbers.

    ## Arguments

    `endopilot/Navigate-v0`: 15 mm into the posterior descending artery of the reference right coronary artery (patient
    0 of the textbook atlas with seed 0). The others are the tasks of the ladder's version 1, as `endopilot/Crux-v0`, in
    patients of their own, which are not those that the ladder is scored on; world i has patient (`patient` + i) modulo
    `patients`. Or give `navigations` of your own.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        navigations: Navigation | Sequence[Navigation] | None = None,
        task: str | None = None,
        patient: int = 0,
        patients: int = 1,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        config: SimulatorConfig = CORE,
    ) -> None:
        """Lay the wires out; `reset` starts the first episodes.

        Args:
            num_envs: number of worlds.
            navigations: one for all worlds, or several, of which world i has number i modulo their number.
            task: in place of them, the name of a task of the ladder.
            patient: the first of its training patients.
            patients: number of its training patients that the worlds have.
            autoreset_mode: whether an ended world is reset at the next step.
            config: settings of the rod core.

        Raises:
            InputError: no world, no such task, or a wire that is slower than an action of 1 or does not fit.
        """
        if num_envs < 1:
            raise InputError(f"num_envs: {num_envs}; give at least 1")
        if autoreset_mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            raise InputError(f"autoreset_mode: {autoreset_mode}; give AutoresetMode.NEXT_STEP or DISABLED")
        if navigations is None:
            navigations = training_navigations(task, patient, patients) if task else reference_navigation()
        given = [navigations] if isinstance(navigations, Navigation) else list(navigations)
        self._prepare([given[world % len(given)] for world in range(num_envs)], autoreset_mode, config)

    def _prepare(self, navigations: list[Navigation], autoreset_mode: AutoresetMode, config: SimulatorConfig) -> None:
        for device in (navigation.device for navigation in navigations):
            if device.max_velocity_mm_s < TRANSLATION_MM_S or device.max_rotation_rad_s < ROTATION_RAD_S:
                raise InputError(
                    f"device {device.name}: max_velocity_mm_s = {device.max_velocity_mm_s:g}, max_rotation_rad_s = "
                    f"{device.max_rotation_rad_s:g}; an action of 1 is {TRANSLATION_MM_S:g} mm/s and "
                    f"{ROTATION_RAD_S:g} rad/s; give a faster device"
                )
        count = len(navigations)
        self.navigations, self._config = tuple(navigations), config
        self.metadata = {"autoreset_mode": autoreset_mode, "render_modes": []}
        self.num_envs = count
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = observation.SPACE
        self.action_space = batch_space(self.single_action_space, count)
        self.observation_space = batch_space(self.single_observation_space, count)
        self._simulator = Simulator(
            [navigation.anatomy for navigation in navigations],
            [navigation.device for navigation in navigations],
            config=config,
        )
        self._routes = RouteTables.of(navigations)
        self._far_ends = np.array([far_end_mm(navigation.anatomy) for navigation in navigations])
        targets = [navigation.target for navigation in navigations]
        self._target_branch = np.array([target.branch for target in targets])
        self._target_abscissa = np.array([target.abscissa for target in targets])
        self._start, self._seconds, self._force_limit = (
            np.array([getattr(navigation, name) for navigation in navigations])
            for name in ("start_inserted_mm", "seconds", "force_limit_n")
        )
        self._everyone = np.ones(count, dtype=bool)
        self._generators = [seeding.np_random()[0] for _ in range(count)]
        self._steps, self._distance = np.zeros(count, dtype=np.int64), np.zeros(count)
        self._safe, self._ended = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "worlds features"], dict[str, Any]]:
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
        now = Measured.current(self._simulator)
        return self._observe(now), self._infos(now, self._distance)

    def step(
        self, actions: ArrayLike
    ) -> tuple[
        Float[np.ndarray, "worlds features"],
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
        if control.shape != (self.num_envs, 2) or not np.isfinite(control).all():
            raise InputError(f"actions: shape {control.shape}; give finite numbers of shape ({self.num_envs}, 2)")
        fresh = self._ended & (self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP)
        control = np.minimum(np.maximum(control, -1.0), 1.0) * _FASTEST
        control[fresh] = 0.0
        travel_mm = (-np.inf, self._far_ends)  # at the ostium the simulator stops the drive by itself
        inserted = self._simulator.inserted_length
        control[:, 0] = within_travel(control[:, 0], inserted, CONTROL_PERIOD_S, travel_mm=travel_mm)
        step = self._simulator.step(control, CONTROL_PERIOD_S)
        now = Measured.after(step, self._simulator)
        if fresh.any():
            self._begin(fresh)
            now = Measured.current(self._simulator)
        return self._judge(now, fresh)

    def _judge(self, now: Measured, fresh: Bool[np.ndarray, "worlds"]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Score what the worlds did in a step, of which those of `fresh` have only begun."""
        going, before = ~fresh, self._distance
        self._steps += going
        self._distance = self._routes.distance(now.tip)
        unsafe = ~(now.contact_force <= self._force_limit) & going
        self._safe &= ~unsafe
        infos = self._infos(now, self._distance)
        success = infos["success"] & going
        rewards = (
            PROGRESS_REWARD * (before - self._distance) + STEP_REWARD + FORCE_REWARD * unsafe + SUCCESS_REWARD * success
        )
        terminations = (success | ~now.valid) & going
        truncations = (infos["time_s"] > self._seconds - 1e-9) & ~terminations & going
        self._ended = terminations | truncations
        return self._observe(now), np.where(fresh, 0.0, rewards), terminations, truncations, infos

    def _observe(self, now: Measured) -> Float[np.ndarray, "worlds features"]:
        time_share = self._steps * CONTROL_PERIOD_S / self._seconds
        return observe(now, self._routes, self._distance, self._force_limit, time_share)

    def draw_from(self, *generators: np.random.Generator) -> None:
        """Let each world draw its starts from a generator that the caller holds."""
        self._generators = list(generators)

    def _begin(self, mask: Bool[np.ndarray, "worlds"]) -> None:
        """Start an episode in the worlds of a mask."""
        turn = np.zeros(self.num_envs)
        worlds = np.flatnonzero(mask)
        turn[worlds] = [self._generators[world].uniform(0.0, 2 * np.pi) for world in worlds]
        self._simulator.reset(inserted_length=self._start, rotation=turn, worlds=worlds.tolist())
        self._steps[mask], self._safe[mask], self._ended[mask] = 0, True, False
        self._distance = np.where(mask, self._routes.distance(self._simulator.project()), self._distance)

    def _infos(self, now: Measured, distance: Float[np.ndarray, "worlds"]) -> dict[str, Any]:
        infos: dict[str, Any] = {  # the names of `_MASKS`
            "contact_force_max": now.contact_force,
            "valid": now.valid,
            "success": reached(now.tip, self._target_branch, self._target_abscissa),
            "safe": self._safe.copy(),
            "distance_mm": distance,
            "inserted_length": now.inserted_length,
            "rotation": now.rotation,
            "tip_abscissa": now.tip.abscissa,
            "tip_offset": now.tip.offset,
            "tip_branch": now.tip.branch,
            "time_s": self._steps * CONTROL_PERIOD_S,
        }
        return infos | dict.fromkeys(_MASKS, self._everyone)

    @property
    def state(self) -> NavigationState:
        """All that the future depends on, to be kept and given to `set_state`."""
        return NavigationState(
            self._simulator.state,
            *(array.copy() for array in (self._steps, self._distance, self._safe, self._ended)),
            generators=tuple(dict(copy.deepcopy(generator.bit_generator.state)) for generator in self._generators),
        )

    def set_state(self, state: NavigationState) -> None:
        """Go back to a state, bit by bit.

        Raises:
            InputError: it is that of other navigations or settings.
        """
        self._simulator.set_state(state.simulator)
        self._steps, self._distance, self._safe, self._ended = (
            array.copy() for array in (state.steps, state.distance, state.safe, state.ended)
        )
        for generator, kept in zip(self._generators, state.generators, strict=True):
            generator.bit_generator.state = copy.deepcopy(kept)

    @property
    def simulator(self) -> Simulator:
        """The worlds, for pictures of the wires; stepping it bypasses the environment."""
        return self._simulator

    def __getstate__(self) -> dict[str, Any]:
        """Return what `__setstate__` makes the environment of again; the rod core itself cannot be pickled."""
        return {
            "navigations": list(self.navigations),
            "autoreset_mode": self.metadata["autoreset_mode"],
            "config": self._config,
            "state": self.state,
            "spec": self.spec,
        }

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self._prepare(kept["navigations"], kept["autoreset_mode"], kept["config"])
        self.set_state(kept["state"])
        self.spec = kept["spec"]
