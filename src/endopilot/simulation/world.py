"""What reality is, as data: `World`, and the YAML files that hold it (`list_worlds`, `read_world`)."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args

import numpy as np
from jaxtyping import Float
from pydantic import BeforeValidator, model_validator
from pydantic_core import PydanticCustomError

from endopilot.anatomy.catheter_axis import turned_axis, with_axis
from endopilot.anatomy.other_lumen import with_radii
from endopilot.anatomy.tree import cross_axes
from endopilot.devices.device import Wire
from endopilot.devices.device_files import named_file
from endopilot.devices.robot import RobotConfig, read_robot
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import write_yaml
from endopilot.settings import (
    LONGEST_S,
    Finite,
    NonNegative,
    OpenShare,
    Share,
    ShareBelowOne,
    Text,
    Within,
    read_settings,
    settings,
)
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion, MotionName, motion_named
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

NOMINAL = "nominal"  # name of the world that is as it is given
_SHIPPED = Path(__file__).parent / "worlds"
_Factor = Annotated[float, Within(0.05, 100)]


def _robot(value: Any) -> Any:
    return read_robot(value) if isinstance(value, (str, Path)) else value


def _motion(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value not in get_args(MotionName) or value == "still":
        raise PydanticCustomError("range", "choose from breathing, heartbeat and both, or give amplitudes")
    return motion_named(cast(MotionName, value))


@settings
class Stenosis:
    """A narrow place of the lumen, which the given vessel does not have."""

    section: Text | None = None
    """Name of the section in the middle of which it lies; on the longest path if not given."""
    at_share: Share = 0.4
    """Where on the longest path it lies, a share of its length, if no section is given."""
    length_mm: Annotated[float, Within(0.5, 100)] = 10.0
    """Length along the centerline, mm."""
    diameter_share: OpenShare = 0.5
    """Share of the diameter that is lost in its middle; it falls off to both ends as a cosine."""


@settings
class World:
    """What reality is where it differs from the navigation that a policy is given. The defaults are as given."""

    about: str = ""
    """What the world is, in a line."""
    tip_bend_factor: Annotated[float, Within(0, 4)] = 1.0
    """Factor on the angle by which the wire's unloaded tip is bent."""
    tip_bend_length_factor: Annotated[float, Within(0.2, 5)] = 1.0
    """Factor on the length over which it is bent; the angle stays."""
    tip_stiffness_factor: _Factor = 1.0
    """Factor on the stiffness of the wire's distal 10 mm, EI and GJ."""
    shaft_stiffness_factor: _Factor = 1.0
    """Factor on the stiffness of the wire behind those; between them it changes as the wire's profile has points."""
    friction_factor: NonNegative = 1.0
    """Factor on the friction coefficient, of wire and catheters."""
    lumen_factor: Annotated[float, Within(0.5, 2)] = 1.0
    """Factor on the lumen's radii."""
    lumen_mm: Annotated[float, Within(-2, 2, unit="mm")] = 0.0
    """The lumen's radii are larger by this, after the factor, mm."""
    occluded: tuple[Text, ...] = ()
    """Names of sections that are missing: closed, with all that lies behind them."""
    stenosis: Stenosis | None = None
    """A narrow place."""
    compliant_wall_n_mm2: Annotated[float, Within(0.01, 1e6)] | None = None
    """Stiffness of a compliant wall, N/mm², as in `SimulatorConfig`; as it is given there if not here."""
    friction_along: tuple[_Factor, ...] = ()
    """Further factors on friction along the vessel: at even distances from the ostium to the end of the longest path,
    linear between. In the guiding catheter the first counts."""
    wall_along: tuple[Annotated[float, Within(0.1, 10)], ...] = ()
    """The same on the stiffness of a compliant wall."""
    wall_around: tuple[Annotated[float, Within(0.1, 10)], ...] = ()
    """Further factors on that around the vessel: at even angles about the centerline, linear between."""
    ostium_mm: Finite = 0.0
    """The wire is inserted this much deeper than the encoder says, mm: the ostium lies elsewhere along the catheter."""
    axis_deg: Annotated[float, Within(0, 45)] = 0.0
    """The guiding catheter leans by this angle off its given axis, degrees."""
    axis_side_deg: Finite | None = None
    """To which side it leans, degrees around the given axis; drawn with the seed if not given."""
    ostium_aside_mm: tuple[Finite, Finite] = (0.0, 0.0)
    """The ostium, and the guiding catheter with it, lies this far beside its given place, mm, along the two axes across
    the given one that `axis_side_deg` counts from."""
    backs_out_mm: Annotated[float, Within(0, 50)] = 0.0
    """The guiding catheter backs out of the ostium by this, mm, at 5 mm/s, and takes all devices back; their encoders
    do not see it, and no device is taken back behind the ostium."""
    backs_out_after_s: Annotated[float, Within(0, LONGEST_S)] = 5.0
    """When it begins to, s after the start."""
    robot: Annotated[RobotConfig | None, BeforeValidator(_robot)] = None
    """The robot as it truly is: a name, a file, or its fields; as given if not here. What is known of it stays."""
    latency_factor: NonNegative = 1.0
    """Factor on the latency of the robot, given or here."""
    element_mm: Annotated[float, Within(0.02, 5)] | None = None
    """Length of the wire's elements at its tip in reality, mm; as given if not here."""
    time_step_s: Annotated[float, Within(1e-5, SAMPLE_PERIOD_S)] | None = None
    """Time step in reality, s, which divides 0.5 s; as given if not here."""
    engine: Literal["rod", "kirchhoff"] = "rod"
    """What moves the wire in reality: the rod core, which policies simulate too, or a Kirchhoff rod that shares none of
    its laws of wire, wall, contact and friction. That moves a wire alone in a rigid vessel that lies still."""
    motion: Annotated[Motion | None, BeforeValidator(_motion)] = None
    """How heart and breath truly move the vessel: breathing, heartbeat, both, or amplitudes; as given if not here."""
    registration_mm: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """X-ray shows the wire displaced by this, mm LPS: the vessel is registered so far beside where it lies."""
    drift_mm_min: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """So much farther it shows displaced with every minute, mm LPS: the patient moves on the table."""
    share: ShareBelowOne = 0.0
    """Friction, tip stiffness, latency and ostium differ by this share, each up or down as drawn with the seed; the
    ostium by this share of the lumen's diameter there. What differs already is not drawn."""

    @model_validator(mode="after")
    def _consistent(self) -> World:
        try:
            self.core(SimulatorConfig())
        except InputError as error:
            raise ValueError(str(error)) from None
        own = ("compliant_wall_n_mm2", "friction_along", "motion")
        clash = next((name for name in own if getattr(self, name) not in (None, ())), None)
        if self.engine != "rod" and clash:
            raise ValueError(f"engine: {self.engine} with {clash}; leave one of them out")
        return self

    def drawn(self, anatomy: Anatomy | None, seed: int) -> World:
        """Return the world with what a navigation's seed draws: the sides of `share`, which takes the anatomy, and that
        to which the catheter leans."""
        random = np.random.default_rng([seed, 3])
        friction, stiffness, latency, ostium = (self.share * random.choice([-1.0, 1.0], 4)).tolist()
        drawn = {"axis_side_deg": float(random.uniform(0.0, 360.0))} if self.axis_deg else {}
        if anatomy is not None and self.share:
            drawn |= {"friction_factor": 1 + friction, "tip_stiffness_factor": 1 + stiffness}
            diameter_mm = 2 * float(anatomy.tree.branches[0].centerline.radius[0])
            drawn |= {"latency_factor": 1 + latency, "ostium_mm": ostium * diameter_mm}
        own = self.differences().keys() - {"share"}
        return replace(self, share=0.0, **{name: value for name, value in drawn.items() if name not in own})

    def wire(self, given: Wire) -> Wire:
        """Return a wire as it is in reality."""
        return replace(
            given.with_tip(
                bend_rad=given.tip_bend_rad * self.tip_bend_factor,
                stiffness_factor=self.tip_stiffness_factor,
                shaft_stiffness_factor=self.shaft_stiffness_factor,
            ),
            tip_bend_length_mm=given.tip_bend_length_mm * self.tip_bend_length_factor,
            friction=given.friction * self.friction_factor,
        )

    def stack(self, given: Stack) -> Stack:
        """Return devices as they are in reality: catheters' friction on the wall differs as the wire's does."""
        around = tuple(replace(each, friction=each.friction * self.friction_factor) for each in given.catheters)
        return replace(given, wire=self.wire(given.wire), catheters=around)

    def axis(self, given: Anatomy) -> Float[np.ndarray, "3"]:
        """Return the guiding catheter's axis in reality, a unit vector into the vessel."""
        if self.axis_deg == 0:
            return given.insertion.direction
        return turned_axis(given.insertion.direction, self.axis_deg, self.axis_side_deg or 0.0)

    def anatomy(self, given: Anatomy) -> Anatomy:
        """Return the vessel with its guiding catheter as it is in reality, its branches as given; InputError for a
        section it lacks."""
        as_given = (self.lumen_factor, self.lumen_mm, self.occluded, self.stenosis) == (1.0, 0.0, (), None)
        real = given if as_given else _with_lumen(given, self.lumen_factor, self.lumen_mm, self.occluded, self.stenosis)
        if self.axis_deg == 0 and not any(self.ostium_aside_mm):
            return real
        across = np.concatenate(cross_axes(given.insertion.direction[None]))
        moved = replace(real.insertion, position=real.insertion.position + self.ostium_aside_mm @ across)
        return with_axis(replace(real, insertion=moved), self.axis(given))

    def registered_mm(self, time_s: float) -> tuple[float, float, float]:
        """Return by how much X-ray shows the wire displaced at a time, s, mm LPS."""
        x, y, z = (at + time_s / 60 * rate for at, rate in zip(self.registration_mm, self.drift_mm_min, strict=True))
        return x, y, z

    def core(self, given: SimulatorConfig) -> SimulatorConfig:
        """Return the settings of the rod core that plays reality."""
        names = ("compliant_wall_n_mm2", "friction_along", "wall_along", "wall_around", "element_mm", "time_step_s")
        own = {name: getattr(self, name) for name in names}
        changed = {name: value for name, value in own.items() if value not in (None, ())}
        return replace(given, **changed) if changed else given

    def check_engine(self, what: str) -> None:
        """Raise InputError, which names `what` the wire is to move in, unless the rod core moves it."""
        if self.engine != "rod":
            raise InputError(f"world: engine = {self.engine}; {what} are of the rod core alone: leave it out")

    def real_robot(self, given: RobotConfig) -> RobotConfig:
        """Return the robot as it truly is."""
        robot = self.robot or given
        return replace(robot, latency_s=robot.latency_s * self.latency_factor)

    def write(self, path: Path | str) -> None:
        """Write what differs as a YAML file for `read_world`, whole or not at all; InputError if that fails."""
        write_yaml(Path(path), self.differences())

    def differences(self) -> dict[str, Any]:
        """Return the names and values of the fields that are not as given."""
        nominal, values = World(), asdict(self)
        return {
            each.name: values[each.name]
            for each in fields(self)
            if getattr(self, each.name) != getattr(nominal, each.name)
        }


def list_worlds() -> tuple[str, ...]:
    """Return the names of the worlds that the package knows."""
    return (NOMINAL, *sorted(path.stem for path in _SHIPPED.glob("*.yaml")))


def read_world(name_or_path: str | Path) -> World:
    """Read a world by its name, or from a YAML file; InputError names file, field, value and mend."""
    if str(name_or_path) == NOMINAL:
        return World()
    path = named_file("world", name_or_path, (_SHIPPED,), list_worlds)
    return read_settings(path, World, onto=World())


@lru_cache(maxsize=1)
def _with_lumen(
    given: Anatomy, factor: float, larger_mm: float, occluded: tuple[str, ...], stenosis: Stenosis | None
) -> Anatomy:
    """Return an anatomy with another lumen; the last one is kept, as making it takes seconds."""
    tree = given.tree
    lines = [branch.centerline for branch in tree.branches]
    radii = [line.radius * factor + larger_mm for line in lines]
    for name in (*occluded, *((stenosis.section,) if stenosis and stenosis.section else ())):
        if name not in tree.sections_present:
            raise InputError(
                f"world: section '{name}'; {given.name} has no such section (it has {', '.join(tree.sections_present)})"
            )
    closed = {tree.section_names.index(name) for name in occluded}
    for index, branch in enumerate(tree.branches):
        shut = np.flatnonzero(np.isin(branch.section, list(closed)))
        behind = branch.parent >= 0 and radii[branch.parent][-1] == 0.0
        if not len(shut) and not behind:
            continue
        along = lines[index].abscissa - lines[index].abscissa[0]
        mouth_mm = 0.0 if behind or branch.parent < 0 else float(lines[branch.parent].radius[-1])
        first_mm = 0.0 if behind else max(mouth_mm, float(along[shut[0]]))  # the parent stays open at the mouth
        radii[index] = np.where(along >= first_mm, 0.0, radii[index])
    if stenosis is not None:
        leaf, middle = _place(given, stenosis)
        for index in tree.route(leaf):
            off = np.clip(np.abs(lines[index].abscissa - middle) / (stenosis.length_mm / 2), 0.0, 1.0)
            radii[index] = radii[index] * (1 - stenosis.diameter_share * 0.5 * (1 + np.cos(np.pi * off)))
    return with_radii(given, radii)


def _place(anatomy: Anatomy, stenosis: Stenosis) -> tuple[int, float]:
    tree = anatomy.tree
    if stenosis.section is None:
        leaf = tree.longest_leaf()
        return leaf, stenosis.at_share * float(tree.branches[leaf].centerline.abscissa[-1])
    wanted = tree.section_names.index(stenosis.section)
    at = [
        (index, float(a)) for index, b in enumerate(tree.branches) for a in b.centerline.abscissa[b.section == wanted]
    ]
    index, abscissa = at[len(at) // 2]
    return index, abscissa
