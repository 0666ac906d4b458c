"""Many worlds, driven step by step: for controllers, planners and learning environments.

`Simulator` keeps the state of its worlds between calls; `simulate` runs whole control sequences at once. Both drive the
same C++ core and give the same answer to the last bit.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.simulation.checks import check_control, check_memory, check_travel
from endopilot.simulation.config import LANES, Actuation, SimulatorConfig
from endopilot.simulation.core import of_device
from endopilot.simulation.groups import Group, group_key, make_groups
from endopilot.simulation.motion import Motion
from endopilot.simulation.processor import gpu_errors
from endopilot.simulation.readout import Readout
from endopilot.simulation.state import SimulatorState, Step, SupportsDLPack
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

_DEEPEST_START = 0.8
"""Share of the longest path that a random start may lie at."""
_LEAST_BYTES = 4000
"""No world takes less memory, bytes; a number of worlds that needs more is refused before they are listed."""


class Simulator(Readout):
    """Many worlds at once, each with an anatomy, a device and controls of its own.

    A world's result does not depend on the others: neither on their number nor on the threads that step them.

    Example:
        >>> simulator = Simulator(anatomy, device, worlds=4)
        >>> simulator.reset(seed=0)
        >>> step = simulator.step(np.tile([5.0, 0.5], (4, 1)), duration=0.1)
        >>> step.tip_position.shape
        (4, 3)
    """

    def __init__(
        self,
        anatomy: Anatomy | Sequence[Anatomy],
        device: Device | Sequence[Device],
        *,
        catheters: Sequence[Catheter] = (),
        worlds: int = 1,
        actuation: Actuation = "velocity",
        motion: Motion | None = None,
        config: SimulatorConfig | None = None,
        sharing: Simulator | None = None,
    ) -> None:
        """Lay the wires out; every world starts with its tip at the ostium.

        Args:
            anatomy: the vessel of all worlds, or one for each.
            device: the wire of all worlds, or one for each.
            catheters: catheters around the wire, from the inside out, of all worlds; they are driven by velocity.
            worlds: their number, where neither of the above says it.
            actuation: what `step` takes: "velocity" (mm/s, rad/s; the drive makes exactly that motion, except that it
                slips rather than push, pull or turn harder than the device's limits) or "force" (axial force N and
                torque N·mm on the wire; advance and rotation follow, against the friction and drag of the introducer).
            motion: how every vessel moves with time; it lies still if not given. Positions and directions are those in
                the vessel as CT shows it; `vessel_to_laboratory` says where that lies.
            config: settings of the rod core.
            sharing: a simulator that has prepared the same anatomy, whose lumen is then not prepared again.

        Raises:
            InputError: a device that does not fit its anatomy or the catheter around it; a distance map that is not
                finite, or negative at the ostium; lists of different lengths; more worlds than the memory holds.
        """
        if actuation not in ("velocity", "force"):
            raise InputError(f"actuation: {actuation!r}; give 'velocity' or 'force'")
        self._config = config or SimulatorConfig()
        if catheters and actuation == "force":
            raise InputError("actuation: 'force' with catheters; give 'velocity'")
        self._by_force, self._motion = actuation == "force", motion
        check_memory(worlds * _LEAST_BYTES, f"worlds: {worlds}", "give fewer")
        anatomies = [anatomy] * worlds if isinstance(anatomy, Anatomy) else list(anatomy)
        devices = [device] * len(anatomies) if isinstance(device, Device) else list(device)
        if isinstance(anatomy, Anatomy) and not isinstance(device, Device):
            anatomies = [anatomy] * len(devices)
        if not anatomies or len(anatomies) != len(devices):
            raise InputError(
                f"anatomy, device: {len(anatomies)} and {len(devices)}; give at least one, and as many of each"
            )
        self._stacks = [Stack(wire, tuple(catheters)) for wire in devices]
        with gpu_errors(self._config.processor):
            self._groups = make_groups(
                anatomies, self._stacks, motion, self._config, sharing._groups if sharing else ()
            )
        self._device = devices
        fastest = np.array(
            [[(each.max_velocity_mm_s, each.max_rotation_rad_s) for each in stack.devices] for stack in self._stacks]
        ).reshape(len(devices), -1)
        self._largest = np.full_like(fastest, np.finfo(float).max) if self._by_force else fastest * (1 + 1e-6)
        self._longest = self._merge([np.full(len(group.index), group.longest_mm) for group in self._groups])
        self.reset(inserted_length=np.zeros(len(devices)), rotation=np.zeros(len(devices)))

    def reset(
        self,
        seed: int | None = None,
        *,
        inserted_length: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        catheter_inserted_length: ArrayLike | None = None,
        catheter_rotation: ArrayLike | None = None,
        worlds: Sequence[int] | None = None,
    ) -> None:
        """Put worlds back to the ostium and push them to their first inserted length.

        What is not given is drawn from `seed` (which is then needed): inserted lengths evenly up to 0.8 of the longest
        path, rotations over a full turn; friction is the device's own if not given. A world's draw depends on the seed
        and its own number alone.

        Args:
            seed: of the random start.
            inserted_length: mm, a number for every world.
            rotation: rad, likewise.
            friction: Coulomb friction coefficient of the wire, likewise.
            catheter_inserted_length: mm, of each world and catheter; 0 if not given.
            catheter_rotation: rad, likewise.
            worlds: the worlds to reset; all if not given. The arrays still hold a number for every world.

        Raises:
            InputError: a number that is not finite or out of range; neither a seed nor a start.

        Example:
            >>> simulator.reset(inserted_length=[5.0, 10.0, 15.0, 20.0], rotation=np.zeros(4))
            >>> simulator.reset(seed=7, worlds=[2])  # the others stay as they are
            >>> simulator.inserted_length.round(3)[[0, 1, 3]]
            array([ 5., 10., 20.])
        """
        chosen = np.arange(self.worlds) if worlds is None else np.array(worlds, dtype=int)
        if ((chosen < 0) | (chosen >= self.worlds)).any():
            raise InputError(f"worlds: {chosen.max()} or {chosen.min()} is no world; there are {self.worlds}")
        if seed is None and (inserted_length is None or rotation is None):
            raise InputError("seed: none given; give one, or inserted_length and rotation of every world")
        start, turn = self._random_start(seed)
        start = start if inserted_length is None else self._per_world("inserted_length", inserted_length)
        turn = turn if rotation is None else self._per_world("rotation", rotation)
        own = np.array([device.friction for device in self._device])
        coefficient = own if friction is None else self._per_world("friction", friction)
        each = (self.worlds, len(self._stacks[0].catheters))
        inner, inner_turn = (
            np.zeros(each) if given is None else self._of_worlds(name, given, each)
            for name, given in (
                ("catheter_inserted_length", catheter_inserted_length),
                ("catheter_rotation", catheter_rotation),
            )
        )
        if (coefficient < 0).any():
            raise InputError(f"friction: world {int(np.argmin(coefficient))}: {coefficient.min():g}; give 0 or more")
        for group in self._groups:
            for name, given in [("inserted_length", start), *(("catheter_inserted_length", at) for at in inner.T)]:
                bad = (given[group.index] < 0) | (given[group.index] > group.longest_mm)
                if bad.any():
                    world = int(group.index[np.argmax(bad)])
                    raise InputError(f"{name}: world {world}: {given[world]:g} mm; give 0 to {group.longest_mm:.1f} mm")
        initial = np.stack([np.column_stack([start, inner]), np.column_stack([turn, inner_turn])], axis=-1)
        for group in self._groups:
            mine = np.isin(group.index, chosen)
            if not mine.any():
                continue
            index = group.index[mine]
            group.simulation.reset(
                index=np.flatnonzero(mine),
                initial=initial[index],
                friction=np.array(
                    [[coefficient[world], *(each.friction for each in group.stack.devices[1:])] for world in index]
                ),
                sample_period=SAMPLE_PERIOD_S,
            )
            no_control = np.zeros((len(group.index), 0, 2 * len(group.stack.devices)))
            self._run(group, no_control, self._config.time_step_s, self._config.steps_per_sample, by_force=False)

    def step(self, control: ArrayLike | SupportsDLPack, duration: float) -> Step:
        """Drive every world for some time with a constant control.

        Args:
            control: a row a world, of translation (mm/s) and rotation (rad/s), or of axial force (N) and torque
                (N·mm), of the wire, then of each catheter; numpy, or anything that speaks DLPack, such as a torch
                tensor on the CPU.
            duration: s; it is cut into equal time steps of at most `config.time_step_s`.

        Returns:
            The worlds at the end of the step. The drive stops where the wire is pulled out to the ostium.

        Raises:
            InputError: a control of another shape, that is not finite, above the device's velocity limit or beyond
                the length of the wire; a duration that is not positive. No world is moved then.

        Example:
            >>> before = simulator.inserted_length
            >>> step = simulator.step([[4.0, 0.0]] * 4, duration=0.25)
            >>> (step.inserted_length - before).round(6)
            array([1., 1., 1., 1.])
        """
        array: Any = control
        if not isinstance(array, np.ndarray) and hasattr(array, "__dlpack__"):
            array = np.from_dlpack(array)
        array = np.ascontiguousarray(array, dtype=float)
        if not (math.isfinite(duration) and duration > 0):
            raise InputError(f"duration: {duration}; give a positive number of seconds")
        check_control(array, self._largest, self._stacks)
        if not self._by_force:
            ends = [self.inserted_length, *self.catheter_inserted_length.T]
            for k, inserted in enumerate(ends):
                check_travel(inserted + array[:, 2 * k] * duration, self._longest)
        steps = max(1, int(np.ceil(duration / self._config.time_step_s - 1e-9)))
        results = [
            self._run(group, array[group.index][:, None], duration / steps, steps, by_force=self._by_force)
            for group in self._groups
        ]
        of_wires = [of_device(result, 0) for result in results]
        return Step(
            **{name: self._merge([result[name][:, 0] for result in of_wires]) for name in Step.__dataclass_fields__}
        )

    @property
    def state(self) -> SimulatorState:
        """The worlds' state, to be kept and given to `set_state`.

        Example:
            >>> kept = simulator.state  # kept.save(path) writes it to a file
        """
        return SimulatorState(tuple(group.simulation.state() for group in self._groups), self._fingerprint)

    def set_state(self, state: SimulatorState) -> None:
        """Restore all worlds, bit by bit.

        Raises:
            InputError: the state is that of other anatomies, devices or settings, of another number of worlds, or of
                another version of endopilot.

        Example:
            >>> kept, control = simulator.state, np.tile([5.0, 0.5], (4, 1))
            >>> once = simulator.step(control, 0.1)
            >>> simulator.set_state(kept)
            >>> np.array_equal(simulator.step(control, 0.1).tip_position, once.tip_position)
            True
        """
        state.check_version()
        if state.fingerprint != self._fingerprint:
            raise InputError(
                "state: made with other anatomies, devices or settings; restore it in a simulator like its own"
            )
        for group, values in zip(self._groups, state.values, strict=True):
            group.simulation.set_state(np.ascontiguousarray(values))

    def copy_worlds(self, source: ArrayLike, *, of: Simulator | None = None) -> None:
        """Put every world where another one, of the same anatomy and device, is now; friction goes with it.

        Args:
            source: for each world, the number of the one that it becomes a copy of; its own to stay as it is.
            of: the simulator that the numbers belong to, made with equal anatomies, devices and settings but
                maybe another number of worlds; this one if not given.

        Raises:
            InputError: not one number for each world, or a world of another anatomy or device, or other settings.

        Example:
            >>> simulator.copy_worlds([0, 0, 2, 2])
            >>> bool((simulator.position[1] == simulator.position[0])[simulator.contacts[0] >= 0].all())
            True
        """
        of = of or self
        chosen = np.asarray(source)
        if chosen.shape != (self.worlds,) or not np.issubdtype(chosen.dtype, np.integer):
            raise InputError(f"source: {source}; give the number of a world for each of the {self.worlds} worlds")
        if self._setup != of._setup:
            raise InputError("of: a simulator with other settings; make both with equal actuation, motion and config")
        originals = {group_key(group.anatomy, group.stack): group for group in of._groups}
        states = []
        for group in self._groups:
            wanted = chosen[group.index]
            original = originals.get(group_key(group.anatomy, group.stack))
            strange = ~np.isin(wanted, original.index if original else [])
            if original is None or strange.any():
                world = int(group.index[np.argmax(strange)])
                raise InputError(
                    f"source: world {world} cannot become world {chosen[world]}, which is none or has another anatomy "
                    "or device; give one like it"
                )
            rows = np.searchsorted(original.index, wanted)
            states.append(np.ascontiguousarray(original.simulation.state()[rows]))
        for group, state in zip(self._groups, states, strict=True):
            group.simulation.set_state(state)

    @property
    def config(self) -> SimulatorConfig:
        """Settings of the rod core.

        Example:
            >>> simulator.config.element_mm
            0.75
        """
        return self._config

    def _random_start(self, seed: int | None) -> tuple[np.ndarray, np.ndarray]:
        if seed is None:
            return np.zeros(self.worlds), np.zeros(self.worlds)
        draw = np.array([np.random.default_rng([seed, world]).random(2) for world in range(self.worlds)])
        deepest = np.empty(self.worlds)
        for group in self._groups:
            deepest[group.index] = _DEEPEST_START * group.path_mm
        return draw[:, 0] * deepest, draw[:, 1] * 2 * np.pi

    def _run(
        self, group: Group, control: np.ndarray, time_step: float, steps: int, *, by_force: bool
    ) -> dict[str, Any]:
        with gpu_errors(self._config.processor):
            return group.simulation.run(
                control=control.reshape(*control.shape[:2], len(group.stack.devices), 2),
                force_driven=by_force,
                time_step=time_step,
                steps_per_sample=steps,
                record_shape=False,
                record_attitude=False,
                threads=self._config.threads_for(len(group.index), LANES),
                lanes=LANES,
                progress=None,
            )

    def _per_world(self, name: str, values: Any) -> Float[np.ndarray, "worlds"]:
        return self._of_worlds(name, values, (self.worlds,))

    def _of_worlds(self, name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
        array = np.asarray(values, dtype=float)
        if array.shape != shape:
            each = "one number" if len(shape) == 1 else f"{shape[1]} numbers"
            raise InputError(f"{name}: shape {array.shape}; give {each} for each of the {self.worlds} worlds")
        if not np.isfinite(array).all():
            world = int(np.argwhere(~np.isfinite(array))[0][0])
            raise InputError(f"{name}: world {world}: not a finite number; correct it")
        return array

    @cached_property
    def _fingerprint(self) -> str:
        """Hash of all that a state belongs to."""
        groups = [(group.index.tolist(), group_key(group.anatomy, group.stack)) for group in self._groups]
        return hashlib.sha256(repr((self._setup, groups)).encode()).hexdigest()

    @property
    def _setup(self) -> tuple[Any, ...]:
        """What a state belongs to besides anatomies and devices: settings, but not where it is stepped."""
        names = (name for name in SimulatorConfig.__dataclass_fields__ if name not in ("processor", "threads"))
        return self._by_force, self._motion, tuple((name, getattr(self._config, name)) for name in names)
