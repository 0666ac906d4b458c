"""★ The tip of a device in three dimensions, from its lines in the images of one view or two: `locate`."""

from __future__ import annotations

from collections.abc import Sequence

from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.settings import public
from endopilot.types import Anatomy
from endopilot.xray.camera import Camera
from endopilot.xray.carm import View
from endopilot.xray.frames import DeviceFrame
from endopilot.xray.tip_filter import LocateConfig, TipFilter, TipLocation


@public
def locate(
    anatomy: Anatomy,
    *,
    frames: Sequence[DeviceFrame],
    cameras: Sequence[Camera | View],
    config: LocateConfig | None = None,
) -> tuple[TipLocation, ...]:
    """Find the tip of a device in each frame of a sequence, by all frames.

    Args:
        anatomy: the vessel; only its tree is used.
        frames: what the cameras show, in the order of time.
        cameras: one or two, or views, whose pixels count from the image's middle; their coordinates are those of the CT
            as far as the patient is registered.
        config: what is known of patient and device before the first frame.

    Raises:
        InputError: a frame has another number of lines than there are cameras.
    """
    cameras, config = tuple(cameras), config or LocateConfig()
    for frame in frames:
        if len(frame.lines) != len(cameras):
            raise InputError(
                f"frame {frame.number}: {len(frame.lines)} lines for {len(cameras)} cameras; give one for each, or None"
            )
    follow, found = TipFilter(anatomy.tree, cameras, config), []
    with progress(f"locate {anatomy.name}", len(frames)) as advance:
        for frame in frames:
            found.append(follow.update(frame.number, frame.lines))
            advance()
    return tuple(({one.frame: one for one in found} | follow.smooth()).values())
