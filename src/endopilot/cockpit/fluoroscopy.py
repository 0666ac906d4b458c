"""The X-ray unit of the cockpit: C-arm, pedal, contrast, roadmap, last image hold, and counters. What does not move in
a view is computed in a thread of its own, first coarsely, then finely; until then there is no X-ray."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from endopilot.cockpit.frames import encode
from endopilot.cockpit.world import Snapshot
from endopilot.tasks.navigation import Target
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
    """How the C-arm stands, LAO (positive) or RAO, and cranial (positive) or caudal, degrees, of two planes or the
    first alone, and what its pedal does: pulses a second, each of a multiple of the usual dose, and whether the vessel
    of the last injection lies under the live image."""

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
    """C-arm, pedal and contrast of one patient, who looks like "CT", "phantom", or "plain" water. So far there were
    `frames`, of both planes together as one, `seconds` of fluoroscopy, and `kerma_ugy`, the air kerma at the patient's
    entrance reference point of both planes, µGy."""

    def __init__(
        self, anatomy: Anatomy, make_imager: Callable[[Volume | None], XrayImager], ct: Volume | None = None
    ) -> None:
        """Compute the first view in the background; without a CT (HU) a coronary artery lies in a phantom's."""
        self.settings, self._anatomy = XraySettings(), anatomy
        self.pedal, self.frames, self.seconds, self.kerma_ugy = False, 0, 0.0, 0.0
        self.background = "plain" if ct is None else "CT"
        self._image_s = self._contrast_s = -np.inf
        self._next_s = 0.0
        self._roadmap: dict[tuple[Any, ...], np.ndarray] = {}
        self._pool = ThreadPoolExecutor(1, initializer=_give_way)
        self._views: dict[tuple[Any, ...], list[Future[Plane]]] = {}  # by plane, first coarse, then fine
        self.imager = make_imager(ct)
        self._prepare()
        self._around: Future[XrayImager] | None = None
        phantom = ct is None and is_coronary(anatomy)
        self._surroundings = (lambda: make_imager(surroundings(anatomy))) if phantom else None

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
        return all(self.plane(plane) is not None for plane in self.settings.planes)

    def plane(self, key: tuple[Any, ...]) -> Plane | None:
        """Return the finest view that there is yet of a plane of `settings`; raises what kept it from being made."""
        done = [view for view in self._views.get(key, ()) if view.done()]
        return done[-1].result() if done else None

    def contrast(self, now_s: float) -> float:
        """Return the share of the full contrast in the vessel at a time of the world, s."""
        since = now_s - self._contrast_s
        share = min(since / _FILL_S, 1.0) if since < CONTRAST_S else float(np.exp(-(since - CONTRAST_S) / _WASH_S))
        return share if share > _GONE else 0.0

    def pulse(self, snapshot: Snapshot) -> list[tuple[str, bytes]]:
        """Return the images of a pulse if one is due, a channel's name and a message each, else none."""
        if self._surroundings is not None:  # with the first cycle, so that the page is there before
            self._around, self._surroundings = self._pool.submit(self._surroundings), None
        if self._around is not None and self._around.done():
            self.imager, self._around, self._views, self.background = self._around.result(), None, {}, "phantom"
            self._prepare()
        period = 1 / self.settings.frames_per_s
        self._next_s = min(self._next_s, snapshot.time_s + period)  # a replay may go back in time
        if not (self.pedal and self.ready and snapshot.time_s >= self._next_s - 1e-9):
            return []
        behind = snapshot.time_s - self._next_s
        self._next_s = self._next_s + period if behind < period else snapshot.time_s + period
        return self.expose(snapshot, seconds=period)

    def expose(self, snapshot: Snapshot, *, seconds: float = 0.0) -> list[tuple[str, bytes]]:
        """Expose once, which counts for some seconds of fluoroscopy, and return the images as `pulse` does."""
        self.frames, self.seconds, self._image_s = self.frames + 1, self.seconds + seconds, snapshot.time_s
        share = self.contrast(snapshot.time_s)
        messages = []
        for number, key in enumerate(self.settings.planes):
            plane = self.plane(key)
            assert plane is not None
            self.kerma_ugy += self.imager.air_kerma_ugy(plane, self.settings.dose)
            if share >= 0.9:
                self._roadmap[key] = plane.vessel_mm
            seed = 2 * self.frames + number
            signal = self.imager.signal(
                plane,
                snapshot.nodes,
                contrast=share,
                dose=self.settings.dose,
                seed=seed,
                catheters=[catheter.nodes for catheter in snapshot.catheters],
            )
            roadmap = self._roadmap.get(key) if self.settings.roadmap and share == 0 else None
            image = self.imager.grey(signal, roadmap=roadmap)
            header = {"plane": number, "angles_deg": key[0], "frame": self.frames, "time_s": round(snapshot.time_s, 4)}
            messages.append((f"image{number}", encode("image", header, grey=image)))
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
            **vars(settings),
        }

    def seen(self, now_s: float, target: Target) -> dict[str, Any]:
        """Return what the page shows of the unit and of a target: place, LPS mm, branch, abscissa (mm), section, and
        column and row in the image of each plane."""
        branch, position = self._anatomy.tree.branches[target.branch], target.position(self._anatomy)
        nearest, found = int(np.abs(branch.centerline.abscissa - target.abscissa).argmin()), []
        place = {
            "position": position.round(3).tolist(),
            "branch": target.branch,
            "abscissa": round(target.abscissa, 2),
            "section": self._anatomy.tree.section_names[int(branch.section[nearest])],
        }
        for angles, factor in self.settings.planes:
            view = view_at(angles, self.imager.isocenter, self.imager.config.geometry)
            right, up = factor * view.project(position)
            middle = (self.imager.config.pixels - 1) / 2
            found.append([round(middle + float(right), 1), round(middle - float(up), 1)])
        return {"xray": self.values(now_s), "target": place, "target_px": found}

    def close(self) -> None:
        """Stop computing."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _prepare(self) -> None:
        """Compute the views that the C-arm is to show, first coarsely, and give up those that it no longer is."""
        for key in self._views.keys() - set(self.settings.planes):
            for view in self._views.pop(key):
                view.cancel()
        for key in self.settings.planes:
            if key not in self._views:
                self._views[key] = [self._pool.submit(self.imager.plane, *key, rays=rays) for rays in (_COARSE, _FINE)]


def _give_way() -> None:
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
