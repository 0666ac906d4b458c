"""Many worlds, driven step by step: for controllers, planners and learning environments; `simulate` runs whole
sequences. Both drive the same C++ core, to the same bits."""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.parallel import CORES
from endopilot.progress import Advance
from endopilot.settings import public
from endopilot.simulation.checks import ROUNDING_MM, check_control, check_memory, check_travel, with_device_axis
from endopilot.simulation.config import FREE_BEHIND_MM, LANES, Actuation, SimulatorConfig, gpu_errors
from endopilot.simulation.core_state import run_along
from endopilot.simulation.groups import Group, Readout, group_key, make_groups
from endopilot.simulation.motion import Motion
from endopilot.simulation.trajectory import SimulationSetUp, SimulatorState, Step, Trajectory
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

_DEEPEST_START = 0.8  # share of the longest path that a random start may lie at
_STATE_FORMAT = 4  # of `SimulatorState`: raised when its values come to mean something else
_PACK = 8  # worlds that count as stepped together, however many the processor steps: a budget buys the same on each
_FEW = _PACK // 2  # as many count where no more are stepped; a lane of one alone takes almost as long
_LEAST_BYTES = 4000  # no world takes less memory; too many are refused before they are listed
_AT_ONCE = ThreadPoolExecutor(CORES)  # steps groups of worlds; the main thread's long runs are left to Ctrl-C, though


def _lanes(worlds: int) -> int:
    """Return how many worlds are stepped side by side where so many are; the bits are the same."""
    return LANES if worlds > _FEW else min(LANES, _FEW) if worlds > 1 else 1


class Stepping(NamedTuple):
    """How worlds, or those that are chosen, are driven: seconds of a time step, and time steps of a sample; whether the
    positions of all nodes are recorded, and who is told of the samples of all worlds that are done."""

    time_step: float
    steps: int
    record_shape: bool = False
    advance: Advance | None = None
    worlds: Bool[np.ndarray, "worlds"] | None = None


class Simulator(Readout):
    """Many worlds at once, each with an anatomy, devices and controls of its own.

    A world's result does not depend on the others: neither on their number nor on the threads that step them. Arrays
    of devices have the wire first, then the catheters around it from the inside out; where a wire is alone, arrays that
    are given may leave the axis of devices out.

    Example:
        >>> simulator = Simulator(anatomy, device, worlds=4)
        >>> simulator.reset(seed=0)
        >>> step = simulator.step(np.tile([5.0, 0.5], (4, 1)), duration_s=0.1)
        >>> step.tip_position.shape
        (4, 1, 3)
    """

    @public
    def __init__(
        self,
        anatomy: Anatomy | Sequence[Anatomy],
        device: Wire | Stack | str | Path | Sequence[Wire | Stack | str | Path],
        *,
        worlds: int = 1,
        actuation: Actuation = "velocity",
        motion: Motion | None = None,
        config: SimulatorConfig | None = None,
        reach_mm: float = 0.0,
    ) -> None:
        """Lay the devices out; every world starts with the wire's tip at the ostium.

        Args:
            anatomy: the vessel of all worlds, or one for each.
            device: the wire or its name, or the wire and its catheters, of all worlds, or one for each.
            worlds: their number, where neither of the above says it.
            actuation: what controls are: "velocity" (mm/s, rad/s; the drive makes exactly that motion, except that it
                slips rather than push, pull or turn harder than the device's limits) or "force" (axial force N and
                torque N·mm on the wire; advance and rotation follow, against the friction and drag of the introducer).
            motion: how every vessel moves with time; it lies still if not given. Positions and directions are those in
                the vessel as CT shows it; `vessel_to_laboratory` says where that lies.
            config: settings of the rod core.
            reach_mm: inserted length that the devices are laid out for, mm; at least 20 mm beyond the end of each
                vessel's longest path.

        Raises:
            InputError: a device that does not fit its anatomy or the catheter around it; a distance map that is not
                finite, or negative at the ostium; lists of different lengths; stacks of different numbers of devices;
                more worlds than the memory holds.
        """
        config = config or SimulatorConfig()
        check_memory(worlds * _LEAST_BYTES, f"worlds: {worlds}", "give fewer")
        one = isinstance(device, Wire | Stack | str | Path)
        anatomies = [anatomy] * worlds if isinstance(anatomy, Anatomy) else list(anatomy)
        stacks = [Stack.of(device)] * len(anatomies) if one else [Stack.of(each) for each in device]
        if isinstance(anatomy, Anatomy) and not one:
            anatomies = [anatomy] * len(stacks)
        if not anatomies or len(anatomies) != len(stacks):
            raise InputError(
                f"anatomy, device: {len(anatomies)} and {len(stacks)}; give at least one, and as many of each"
            )
        counts = {len(stack) for stack in stacks}
        if len(counts) > 1:
            raise InputError(f"device: stacks of {min(counts)} and of {max(counts)} devices; give worlds of one number")
        self._devices = counts.pop()
        if self._devices > 1 and actuation == "force":
            raise InputError("actuation: 'force' with catheters; give 'velocity'")
        if actuation == "force" and any(one.length_mm > 0 for stack in stacks for one in stack.transmissions):
            raise InputError("actuation: 'force' with a length between drive and ostium; give 'velocity'")
        with gpu_errors(config.processor):
            self._groups = make_groups(anatomies, stacks, motion, config, reach_mm)
        self._rows = np.argsort(np.concatenate([group.index for group in self._groups]))
        self._longest = self._merge([np.full(len(group.index), group.longest_mm) for group in self._groups])
        own = np.array([[each.friction for each in stack.devices] for stack in stacks])
        self._set_up = SimulationSetUp(anatomies, stacks, np.zeros((*own.shape, 2)), own, actuation, motion, config)
        self._own_friction, self._largest = own, self._set_up.largest
        self.reset(inserted_length=np.zeros(own.shape), rotation=np.zeros(own.shape))

    def reset(
        self,
        seed: int | None = None,
        *,
        inserted_length: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        worlds: Sequence[int] | None = None,
    ) -> None:
        """Put worlds back to the ostium and push them to their first inserted length.

        The wire is pushed there at `config.approach_velocity_mm_s`, with its catheters along with it, and then rests
        for 0.5 s. What is not given is drawn from `seed` (which is then needed): the wire's inserted length evenly up
        to 0.8 of the longest path, its rotation over a full turn; catheters then lie at the ostium. Friction is the
        devices' own if not given. A world's draw depends on the seed and its own number alone.

        Args:
            seed: of the random start.
            inserted_length: mm, of every world and device.
            rotation: rad, likewise.
            friction: Coulomb friction coefficient on the wall, likewise.
            worlds: the worlds to reset; all if not given. The arrays still hold a row for every world.

        Raises:
            InputError: a number that is not finite or out of range; neither a seed nor a start.

        Example:
            >>> simulator.reset(inserted_length=[5.0, 10.0, 15.0, 20.0], rotation=np.zeros(4))
            >>> simulator.reset(seed=7, worlds=[2])  # the others stay as they are
            >>> simulator.inserted_length[[0, 1, 3], 0].round(3)
            array([ 5., 10., 20.])
        """
        chosen = np.arange(self.worlds) if worlds is None else np.array(worlds, dtype=int)
        if ((chosen < 0) | (chosen >= self.worlds)).any():
            raise InputError(f"worlds: {chosen.max()} or {chosen.min()} is no world; there are {self.worlds}")
        if seed is None and (inserted_length is None or rotation is None):
            raise InputError("seed: none given; give one, or inserted_length and rotation of every world")
        start, turn = np.zeros((2, self.worlds, self._devices))
        if seed is not None:
            draw = np.array([np.random.default_rng([seed, world]).random(2) for world in range(self.worlds)])
            deepest = self._merge([np.full(len(group.index), _DEEPEST_START * group.path_mm) for group in self._groups])
            start[:, 0], turn[:, 0] = draw[:, 0] * deepest, draw[:, 1] * 2 * np.pi
        start = start if inserted_length is None else self._of_devices_given("inserted_length", inserted_length)
        turn = turn if rotation is None else self._of_devices_given("rotation", rotation)
        own = self._own_friction
        coefficient = own if friction is None else self._of_devices_given("friction", friction)
        if (coefficient < 0).any():
            world = int(np.argmin(coefficient.min(axis=1)))
            raise InputError(f"friction: world {world}: {coefficient.min():g}; give 0 or more")
        bad = (start < -ROUNDING_MM) | (start > self._longest[:, None])
        if bad.any():
            world, device = (int(place) for place in np.argwhere(bad)[0])
            most = f"{self._longest[world]:.1f} mm"
            which = f", device {device}" if self._devices > 1 else ""
            raise InputError(f"inserted_length: world {world}{which}: {start[world, device]:g} mm; give 0 to {most}")
        initial = np.stack([start, turn], axis=-1)
        for group in self._groups:
            mine = np.isin(group.index, chosen)
            if not mine.any():
                continue
            index = group.index[mine]
            group.simulation.reset(
                index=np.flatnonzero(mine),
                initial=initial[index],
                friction=coefficient[index],
                sample_period=SAMPLE_PERIOD_S,
            )
            no_control = np.zeros((len(group.index), 0, self._devices, 2))
            self._run(group, no_control, Stepping(self.config.time_step_s, self.config.steps_per_sample))
        resets = np.isin(np.arange(self.worlds), chosen)
        self._set_up = replace(
            self._set_up,
            initial=np.where(resets[:, None, None], initial, self._set_up.initial),
            friction=np.where(resets[:, None], coefficient, self._set_up.friction),
        )

    def step(self, control: ArrayLike, duration_s: float, *, worlds: Bool[np.ndarray, "worlds"] | None = None) -> Step:
        """Drive worlds for some time with a constant control.

        Args:
            control: translation (mm/s) and rotation (rad/s), or axial force (N) and torque (N·mm), of each world and
                device; anything that numpy makes an array of, such as a torch tensor on the CPU.
            duration_s: time that the control holds, s; it is cut into equal time steps of at most `config.time_step_s`.
            worlds: which worlds are driven; all if not given. For the others no time passes, and what is returned of
                them is 0.

        Returns:
            The worlds at the end of the step. The drive stops where a device is pulled out to the ostium.

        Raises:
            InputError: a control of another shape, that is not finite, above the device's velocity limit or beyond
                the length of the device; a duration that is not positive. No world is moved then.

        Example:
            >>> before = simulator.inserted_length
            >>> step = simulator.step([[4.0, 0.0]] * 4, duration_s=0.25)
            >>> (step.inserted_length - before)[:, 0].round(6)
            array([1., 1., 1., 1.])
        """
        if not (math.isfinite(duration_s) and duration_s > 0):
            raise InputError(f"duration_s: {duration_s}; give a positive number of seconds")
        array = self._checked(control, duration_s, sequence=False)
        steps = self.config.steps_of(duration_s)
        result = self._run_all(array, Stepping(duration_s / steps, steps, worlds=worlds))
        return Step(**{name: result[name][:, 0] for name in Step.__dataclass_fields__})

    def run(
        self,
        control: ArrayLike,
        *,
        period_s: float = SAMPLE_PERIOD_S,
        record_shape: bool = False,
        advance: Advance | None = None,
    ) -> Trajectory:
        """Drive every world with a sequence of controls, and record it at the end of each.

        Args:
            control: mm/s and rad/s, or N and N·mm, of each world, sample and device.
            period_s: time that each control holds, s.
            record_shape: record the positions of all nodes too.
            advance: called with the number of samples of all worlds that were simulated since the last call.

        Raises:
            InputError: a control of another shape, that is not finite, too fast for its device or that may lead
                deeper than devices are laid out for; a period that is not positive. No world is moved then.

        Example:
            >>> simulator.reset(seed=0)
            >>> trajectory = simulator.run(np.tile([2.0, 0.5], (4, 6, 1)))
            >>> trajectory.tip_position.shape
            (4, 6, 1, 3)
        """
        if not 0 < period_s < np.inf:
            raise InputError(f"period_s: {period_s}; give a positive number of seconds")
        command = self._checked(control, period_s, sequence=True)
        begun, steps = self._begun, self.config.steps_of(period_s)
        result = self._run_all(command, Stepping(period_s / steps, steps, record_shape, advance))
        return self._made(begun, command, period_s, result)

    @property
    def _begun(self) -> tuple[SimulationSetUp, Float[np.ndarray, "worlds devices 2"], Float[np.ndarray, "worlds"]]:
        """What a recording that begins now is to know later: set-up, start and time."""
        return self._set_up, self.proximal, self.time

    def _made(
        self, begun: tuple[Any, ...], command: np.ndarray, period_s: float, result: Mapping[str, np.ndarray]
    ) -> Trajectory:
        """Return what was recorded as a trajectory, given how it began, commands and the arrays of `Step`."""
        set_up, start, began_s = begun
        recorded: dict[str, Any] = {name: result[name] for name in Step.__dataclass_fields__}
        times = began_s[:, None] + period_s * np.arange(1, command.shape[1] + 1)
        return Trajectory(
            set_up=set_up,
            period_s=period_s,
            start=start,
            command=command,
            tip=self._projected(self._of_groups(result["tip_position"])),
            reason=self.reason,
            shape=result.get("shape"),
            vessel_to_laboratory=None if set_up.motion is None else self._placements(times),
            **recorded,
        )

    def evaluations(self, step: Step) -> float:
        """Return how many evaluations of nodes a step cost, those of lanes among them that waited for another world.

        Example:
            >>> step = simulator.step(np.zeros((4, 2)), 0.1)
            >>> bool(simulator.evaluations(step) >= step.node_iterations.sum())
            True
        """
        spent = 0.0
        for group in self._groups:
            of = step.node_iterations[group.index]
            of = of[of > 0]
            pack = _PACK if len(of) > _FEW else _FEW
            spent += pack * max(-(-len(of) // pack) * of.mean(), of.max()) if len(of) else 0.0
        return float(spent)

    @property
    def state(self) -> SimulatorState:
        """The worlds' state, to be kept and given to `set_state`; `simulator.state.write(path)` writes it to a file."""
        return SimulatorState(tuple(group.simulation.state() for group in self._groups), self._fingerprint)

    def set_state(self, state: SimulatorState) -> None:
        """Restore all worlds, bit by bit; InputError for the state of other anatomies, devices, settings or versions.

        Example:
            >>> kept, control = simulator.state, np.tile([5.0, simulator.config.element_mm], (4, 1))
            >>> once = simulator.step(control, 0.1)
            >>> simulator.set_state(kept)
            >>> np.array_equal(simulator.step(control, 0.1).tip_position, once.tip_position)
            True
            >>> simulator.set_up.initial.shape
            (4, 1, 2)
        """
        if state.fingerprint != self._fingerprint:
            raise InputError(
                "state: made with other anatomies, devices, settings or version; restore it in a simulator like its own"
            )
        for group, values in zip(self._groups, state.values, strict=True):
            group.simulation.set_state(np.ascontiguousarray(values))
        self._go_on_their_way()

    def copy_worlds(self, source: ArrayLike, *, of: Simulator | None = None) -> None:
        """Put every world where another one, of the same anatomy and device, is now; friction goes with it.

        `source` has, for each world, the number of the one that it becomes a copy of, among those `of` another
        simulator of equal anatomies, devices and settings if given. Raises InputError for other numbers or worlds.

        Example:
            >>> simulator.copy_worlds([0, 0, 2, 2])
            >>> bool((simulator.position[1] == simulator.position[0])[simulator.contacts[0] >= 0].all())
            True
        """
        of = of or self
        chosen = np.asarray(source)
        if chosen.shape != (self.worlds,) or not np.issubdtype(chosen.dtype, np.integer):
            raise InputError(f"source: {source}; give the number of a world for each of the {self.worlds} worlds")
        if self._settings != of._settings:
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
        self._go_on_their_way()

    @property
    def set_up(self) -> SimulationSetUp:
        """What the worlds are simulated with, and where they started."""
        return self._set_up

    @property
    def config(self) -> SimulatorConfig:
        """Settings of the rod core."""
        return self._set_up.config

    def _checked(
        self, control: ArrayLike, period_s: float, *, sequence: bool
    ) -> Float[np.ndarray, "worlds samples devices 2"]:
        array = np.asarray(control, dtype=float)
        samples = array.shape[1:2] if sequence else ()
        array = with_device_axis("control", array, (self.worlds, *samples, self._devices, 2))
        array = np.ascontiguousarray(array if sequence else array[:, None])
        check_control(array, self._largest, self._set_up.stacks, self._set_up.actuation)
        if self._set_up.actuation == "velocity":
            ahead = array[..., 0] * period_s
            # The approach may have left a loose device a little deeper than it was asked to be.
            begun = np.fmin(self.inserted_length, self._set_up.initial[..., 0])
            check_travel(begun + np.maximum(ahead, 0.0).sum(axis=1), self._longest)
        return array

    def _run_all(self, control: Float[np.ndarray, "worlds samples devices 2"], how: Stepping) -> dict[str, np.ndarray]:
        """Step worlds; from now on all are on their way."""
        in_main = threading.current_thread() is threading.main_thread()
        one_by_one = self.config.threads == 1 or (in_main and control.shape[1] > 1)
        each = map if one_by_one or len(self._groups) == 1 else _AT_ONCE.map
        results = list(each(self._run, self._groups, self._of_groups(control), [how] * len(self._groups)))
        if control.size and not np.isnan(self._set_up.initial).all():
            self._go_on_their_way()
        if how.record_shape:  # of the wires that were needed
            shapes, inserted = ([result[name] for result in results] for name in ("shape", "inserted_length"))
            for result, shape in zip(results, self._needed_nodes(shapes, inserted), strict=True):
                result["shape"] = shape
        return {name: self._merge([result[name] for result in results]) for name in results[0]}

    def _shown(
        self,
        shape: Float[np.ndarray, "worlds samples all_nodes 3"],
        inserted: Float[np.ndarray, "worlds samples devices"],
    ) -> Float[np.ndarray, "worlds samples nodes 3"]:
        """Return shapes that were read step by step as `run` records them."""
        return self._merge(self._needed_nodes(self._of_groups(shape), self._of_groups(inserted)))

    def _needed_nodes(
        self,
        shapes: Sequence[Float[np.ndarray, "_ samples nodes_of_group 3"]],
        inserted: Sequence[Float[np.ndarray, "_ samples devices"]],
    ) -> list[Float[np.ndarray, "_ samples nodes 3"]]:
        """Return each group's shapes without the nodes that nothing needed, NaN beyond those of a shorter wire."""
        kept = []
        for group, shape, lengths in zip(self._groups, shapes, inserted, strict=True):
            needed = max(group.path_mm, float(lengths.max())) + FREE_BEHIND_MM
            nodes = min(int(np.searchsorted(group.rod.abscissa_mm, needed)) + 3, group.simulation.nodes)
            kept.append(shape[:, :, :nodes])
        most = max(shape.shape[2] for shape in kept)
        beyond = [((0, 0), (0, 0), (0, most - shape.shape[2]), (0, 0)) for shape in kept]
        return [np.pad(shape, width, constant_values=np.nan) for shape, width in zip(kept, beyond, strict=True)]

    def _run(
        self, group: Group, control: Float[np.ndarray, "members samples devices 2"], how: Stepping
    ) -> dict[str, np.ndarray]:
        if how.worlds is not None and self.config.friction_along:  # it is scaled in all of them
            raise InputError("worlds: some are given where friction differs along the vessel; leave them out")
        chosen = np.arange(len(group.index)) if how.worlds is None else np.flatnonzero(how.worlds[group.index])
        run = partial(
            group.simulation.run,
            force_driven=self._set_up.actuation == "force",
            time_step=how.time_step,
            record_shape=how.record_shape,
            record_attitude=False,
            threads=self.config.threads_for(len(group.index), LANES),
            lanes=_lanes(len(chosen)),
            chosen=chosen,
        )
        with gpu_errors(self.config.processor):
            if self.config.friction_along and control.shape[1]:
                return run_along(group, control, how.steps, self.config.friction_along, run, how.advance)
            return run(control=control, steps_per_sample=how.steps, progress=how.advance)

    def _go_on_their_way(self) -> None:
        """Note that the worlds are no longer at their start: what follows is not replayed from there."""
        self._set_up = replace(self._set_up, initial=np.full_like(self._set_up.initial, np.nan))

    def _of_devices_given(self, name: str, values: ArrayLike) -> Float[np.ndarray, "worlds devices"]:
        array = with_device_axis(name, np.asarray(values, dtype=float), (self.worlds, self._devices))
        if not np.isfinite(array).all():
            world = int(np.argwhere(~np.isfinite(array))[0][0])
            raise InputError(f"{name}: world {world}: not a finite number; correct it")
        return array

    @cached_property
    def _fingerprint(self) -> str:
        groups = [(group.index.tolist(), group_key(group.anatomy, group.stack)) for group in self._groups]
        return hashlib.sha256(repr((_STATE_FORMAT, self._settings, groups)).encode()).hexdigest()

    @property
    def _settings(self) -> tuple[Any, ...]:
        """What a state belongs to besides anatomies and devices: settings, but not where it is stepped."""
        names = (name for name in SimulatorConfig.__dataclass_fields__ if name not in ("processor", "threads"))
        made = tuple((name, value) for name in names if (value := getattr(self.config, name)) != ())
        return self._set_up.actuation == "force", self._set_up.motion, made
