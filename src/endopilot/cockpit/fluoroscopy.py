"""The X-ray unit of the cockpit: C-arm, pedal, contrast, roadmap, last image hold, and counters. What does not move in
a view is computed in a thread of its own, first coarsely, then finely; until then there is no X-ray."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.cockpit.frames import encode
from endopilot.cockpit.world import Snapshot
from endopilot.types import Anatomy, Volume
from endopilot.xray.absorbers import is_coronary, surroundings
from endopilot.xray.carm import view_at
from endopilot.xray.image import Plane, XrayImager

CONTRAST_S = 2.0  # how long an injection fills the vessel, s; then the blood washes it out
_FILL_S, _WASH_S, _GONE = 0.2, 0.4, 0.02
_COARSE, _FINE = 96, 256
_NICE = 10  # of the thread that computes views: the wire goes first


@dataclass(frozen=True)
class XraySettings:
    """How the C-arm stands and what its pedal does.

    Attributes:
        angles_deg: LAO (positive) or RAO, and cranial (positive) or caudal, of each plane, degrees.
        biplane: two planes, or the first alone.
        frames_per_s: pulses of fluoroscopy, 1/s.
        dose: of a frame, as a multiple of the usual one.
        roadmap: lay the vessel of the last injection under the live image.
    """

    angles_deg: tuple[tuple[float, float], tuple[float, float]] = ((-30.0, 0.0), (60.0, 0.0))
    zoom: float = 1.0
    biplane: bool = False
    frames_per_s: float = 7.5
    dose: float = 1.0
    roadmap: bool = False

    @property
    def planes(self) -> tuple[tuple[tuple[float, float], float], ...]:
        """Angles and zoom of each plane that is used."""
        return tuple((angles, self.zoom) for angles in self.angles_deg[: 2 if self.biplane else 1])


class XrayUnit:
    """C-arm, pedal and contrast of one patient; `configure` changes its settings.

    Attributes:
        frames: exposures so far, of both planes together as one; `seconds` of fluoroscopy, s.
        kerma_ugy: air kerma at the patient's entrance reference point so far, both planes, µGy.
        background: what the patient looks like: "CT", "phantom", or "plain" water.
    """

    def __init__(
        self, anatomy: Anatomy, make_imager: Callable[[Volume | None], XrayImager], ct: Volume | None = None
    ) -> None:
        """Compute the first view in the background; without a CT (HU) a coronary artery lies in a phantom's."""
        self.settings = XraySettings()
        self.pedal, self.frames, self.seconds, self.kerma_ugy = False, 0, 0.0, 0.0
        self.background = "plain" if ct is None else "CT"
        self._image_s = self._contrast_s = -np.inf
        self._next_s = 0.0
        self._planes: dict[tuple[Any, ...], Plane] = {}
        self._fine: set[tuple[Any, ...]] = set()
        self._roadmap: dict[tuple[Any, ...], np.ndarray] = {}
        self._lock, self._pool = threading.Lock(), ThreadPoolExecutor(1)
        self._failed: BaseException | None = None
        self._imager = make_imager(ct)
        self._prepare()
        self._later = ct is None and is_coronary(anatomy)
        self._surroundings = lambda: self._surround(anatomy, make_imager)

    def configure(self, **changes: Any) -> None:
        """Turn or set the C-arm; `changes` are fields of `XraySettings`."""
        self.settings = replace(self.settings, **changes)
        self._prepare()

    def inject(self, now_s: float) -> None:
        """Inject contrast agent at a time of the world, s."""
        self._contrast_s = now_s

    @property
    def ready(self) -> bool:
        """Whether the C-arm stands where it was asked to."""
        with self._lock:
            return all(plane in self._planes for plane in self.settings.planes)

    def contrast(self, now_s: float) -> float:
        """Return the share of the full contrast in the vessel at a time of the world, s."""
        since = now_s - self._contrast_s
        share = min(since / _FILL_S, 1.0) if since < CONTRAST_S else float(np.exp(-(since - CONTRAST_S) / _WASH_S))
        return share if share > _GONE else 0.0

    def pulse(self, snapshot: Snapshot) -> list[bytes] | None:
        """Return the images of a pulse if one is due, as messages for the page, else None."""
        if self._failed is not None:
            raise RuntimeError("the X-ray image could not be computed") from self._failed
        if self._later:  # with the first cycle, so that the page is there before
            self._later = False
            self._pool.submit(self._work, self._surroundings)
        period = 1 / self.settings.frames_per_s
        self._next_s = min(self._next_s, snapshot.time_s + period)  # a replay may go back in time
        if not (self.pedal and self.ready and snapshot.time_s >= self._next_s - 1e-9):
            return None
        behind = snapshot.time_s - self._next_s
        self._next_s = self._next_s + period if behind < period else snapshot.time_s + period
        return self.expose(snapshot, seconds=period)

    def expose(self, snapshot: Snapshot, *, seconds: float = 0.0) -> list[bytes]:
        """Expose once, which counts for some seconds of fluoroscopy, and return the images as messages for the page."""
        self.frames, self.seconds, self._image_s = self.frames + 1, self.seconds + seconds, snapshot.time_s
        share = self.contrast(snapshot.time_s)
        messages = []
        for number, key in enumerate(self.settings.planes):
            with self._lock:
                plane = self._planes[key]
            self.kerma_ugy += self._imager.air_kerma_ugy(plane, self.settings.dose)
            if share >= 0.9:
                self._roadmap[key] = plane.vessel_mm
            seed = 2 * self.frames + number
            signal = self._imager.signal(
                plane,
                snapshot.nodes,
                contrast=share,
                dose=self.settings.dose,
                seed=seed,
                catheters=[catheter.nodes for catheter in snapshot.catheters],
            )
            roadmap = self._roadmap.get(key) if self.settings.roadmap and share == 0 else None
            image = self._imager.grey(signal, roadmap=roadmap)
            header = {"plane": number, "angles_deg": key[0], "frame": self.frames, "time_s": round(snapshot.time_s, 4)}
            messages.append(encode("image", header, grey=image))
        return messages

    def values(self, now_s: float) -> dict[str, Any]:
        """Return what the page shows of the unit at a time of the world, s."""
        settings = self.settings
        return {
            "on": self.pedal and self.ready,
            "ready": self.ready,
            "age_s": None if np.isinf(self._image_s) else round(now_s - self._image_s, 2),
            "frames": self.frames,
            "seconds": round(self.seconds, 1),
            "kerma_ugy": round(self.kerma_ugy, 1),
            "contrast": round(self.contrast(now_s), 2),
            "has_roadmap": any(plane in self._roadmap for plane in settings.planes),
            "background": self.background,
            "angles_deg": settings.angles_deg,
            "zoom": settings.zoom,
            "biplane": settings.biplane,
            "frames_per_s": settings.frames_per_s,
            "dose": settings.dose,
            "roadmap": settings.roadmap,
        }

    def pixels(self, point: Float[np.ndarray, "3"]) -> list[list[float]]:
        """Return where a point of the patient, LPS mm, lies in the image of each plane: column and row."""
        found = []
        for angles, factor in self.settings.planes:
            view = view_at(angles, self._imager.isocenter, self._imager.config.geometry)
            right, up = factor * view.project(point)
            middle = (self._imager.config.pixels - 1) / 2
            found.append([round(middle + float(right), 1), round(middle - float(up), 1)])
        return found

    def close(self) -> None:
        """Stop computing."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _surround(self, anatomy: Anatomy, make_imager: Callable[[Volume | None], XrayImager]) -> None:
        """Put the phantom around the vessel, and compute the views again."""
        imager = make_imager(surroundings(anatomy))
        planes = {key: imager.plane(*key, rays=_COARSE) for key in self.settings.planes}
        with self._lock:
            self._imager, self._planes, self._fine, self.background = imager, planes, set(), "phantom"
        self._prepare()

    def _prepare(self) -> None:
        for key in self.settings.planes:
            for rays in (_COARSE, _FINE):
                self._pool.submit(self._work, lambda key=key, rays=rays: self._compute(key, rays))

    def _compute(self, key: tuple[Any, ...], rays: int) -> None:
        with self._lock:
            if key not in self.settings.planes or key in self._fine or (rays == _COARSE and key in self._planes):
                return
            imager = self._imager
        plane = imager.plane(*key, rays=rays)
        with self._lock:
            self._planes[key] = plane
            if rays == _FINE:
                self._fine.add(key)

    def _work(self, task: Callable[[], None]) -> None:
        if hasattr(os, "setpriority"):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        try:
            task()
        except Exception as error:  # shown in the page by the next pulse, not lost in a thread
            self._failed = error
