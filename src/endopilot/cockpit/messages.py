"""What a page may send: one small JSON object a message, checked against a schema before anything is done."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from endopilot.devices.catheter import MOST_CATHETERS

LONGEST_MESSAGE = 2048  # a longer message closes the connection, bytes
_LONGEST_ANSWER = 300
_Speed = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
_Angle = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Drive(_Message):
    """Move wire and catheters (from the inside out, the rest stands still) at mm/s and rad/s until the next such
    message, which must come within 200 ms."""

    type: Literal["drive"]
    translation: _Speed
    rotation: _Speed
    catheters: Annotated[tuple[tuple[_Speed, _Speed], ...], Field(max_length=MOST_CATHETERS)] = ()


class Pedal(_Message):
    """Press or release the X-ray pedal; while it is pressed, a `drive` or `pedal` must come every 200 ms."""

    type: Literal["pedal"]
    down: bool


class Contrast(_Message):
    """Inject contrast agent."""

    type: Literal["contrast"]


class CArm(_Message):
    """Turn and set the C-arm, as `fluoroscopy.XraySettings` describes; what is not given stays."""

    type: Literal["c_arm"]
    angles_deg: tuple[tuple[_Angle, _Angle], tuple[_Angle, _Angle]] | None = None
    zoom: Annotated[float, Field(ge=0.25, le=4, allow_inf_nan=False)] | None = None
    biplane: bool | None = None
    frames_per_s: Literal[4, 7.5, 15, 30] | None = None
    dose: Annotated[float, Field(ge=0.1, le=10, allow_inf_nan=False)] | None = None
    roadmap: bool | None = None


class Target(_Message):
    """Set the target: the middle of a named section, or a place by its distance along a branch's path, mm."""

    type: Literal["target"]
    section: Annotated[str, Field(max_length=80)] | None = None
    branch: Annotated[int, Field(ge=0, le=10_000)] | None = None
    abscissa: Annotated[float, Field(ge=0, le=1e5, allow_inf_nan=False)] | None = None


class Autopilot(_Message):
    """Hand the wire to one of the policies offered ("start"), let it "pause" or "resume", or take over ("stop")."""

    type: Literal["autopilot"]
    action: Literal["start", "pause", "resume", "stop"]
    policy: Annotated[str, Field(max_length=80)] | None = None


class Game(_Message):
    """Start the clock of a task."""

    type: Literal["game"]
    action: Literal["start"]


class Replay(_Message):
    """Play, pause or seek in what is replayed."""

    type: Literal["replay"]
    playing: bool | None = None
    at_s: Annotated[float, Field(ge=0, le=1e7, allow_inf_nan=False)] | None = None


class Wheel(_Message):
    """Take the wheel if nobody has it, or let it go."""

    type: Literal["wheel"]
    take: bool


class Ping(_Message):
    """Ask for an answer with the same number, to measure the time that it takes."""

    type: Literal["ping"]
    number: Annotated[int, Field(ge=0, le=2**31)]


Message = Drive | Pedal | Contrast | CArm | Target | Autopilot | Game | Replay | Wheel | Ping  # all a page may send
_READER: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="type")])


def read_message(text: str | bytes) -> Message:
    """Return the message in a text; ValueError says in one line why it is none."""
    if len(text) > LONGEST_MESSAGE:
        raise ValueError(f"message of {len(text)} bytes; the longest is {LONGEST_MESSAGE}")
    try:
        return _READER.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "message"
        raise ValueError(" ".join(f"{where}: {first['msg']}".split())[:_LONGEST_ANSWER]) from None
