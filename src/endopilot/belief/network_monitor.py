"""A wire that is followed by a trained run: `NetworkMonitor`, for whoever drives without simulated wires."""

from __future__ import annotations

import numpy as np

from endopilot.belief.bands import AdviserConfig, Calibration, Predicted
from endopilot.belief.monitor import BelievedTip
from endopilot.belief.watch import Watch
from endopilot.devices.stack import Proximals
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, Predictor
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.xray.fluoroscope import TipMeasurement


class NetworkMonitor:
    """Follows a wire as a `Monitor` does, by networks that go on from the last `WINDOW` states, as X-ray measured them
    or as they were predicted. Of the first `WINDOW`, X-ray has to show every one.

    Attributes:
        predicted: of the tip, at the last step; networks state no spread.
    """

    def __init__(
        self, predictor: Predictor, navigation: Navigation, calibration: Calibration | None, advice: AdviserConfig
    ) -> None:
        """Begin a navigation; without a calibration nothing is asked for."""
        self._predictor, self._navigation = predictor, navigation
        self._proximal, self._tips, self._branch = list[np.ndarray](), list[np.ndarray](), 0
        start = navigation.start[0]
        self.predicted = self._at(start, np.array([start[0], 0.0]))
        self._watch = None
        if calibration is not None:
            radius_mm = navigation.device.tip_radius_mm
            self._watch = Watch(calibration, advice, radius_mm, self.predicted, alone=False)

    def step(self, encoders: Proximals, load: Proximals = (), exposure: TipMeasurement | None = None) -> BelievedTip:
        """Take what is measured, a period after the last; `load` says nothing to networks."""
        self._proximal.append(np.array(encoders[0]))
        at = self._at(self._proximal[-1], self._rolled() if len(self._tips) > WINDOW else self.predicted.tip)
        if self._watch is not None:
            self._watch.move(at)
        if exposure is not None:
            if self._watch is not None and len(self._tips) > WINDOW:
                self._watch.compare(exposure.less(at.tip), exposure.tip_sd_mm)
            self._branch = exposure.branch
            at = self._at(self._proximal[-1], np.array([exposure.abscissa, exposure.offset]))
            if self._watch is not None:
                self._watch.exposed(exposure.offset, at)
        self.predicted = at
        self._tips.append(at.tip)
        abscissa, offset = at.tip.tolist()
        if self._watch is None:
            return BelievedTip(abscissa, offset, branch=self._branch)
        asks = self._watch.reason if self._watch.advise(at) else ""
        along, across = self._watch.half_width.tolist()
        return BelievedTip(abscissa, offset, (along, across), asks, branch=self._branch)

    def _at(self, proximal: np.ndarray, tip: np.ndarray) -> Predicted:
        line = self._navigation.anatomy.tree.path(self._branch)
        return Predicted(proximal, tip, np.zeros(2), float(np.interp(tip[0], line.abscissa, line.radius)))

    def _rolled(self) -> np.ndarray:
        """Return the tip that follows from the last `WINDOW` states and the motion since."""
        proximal, tips = np.array(self._proximal[-WINDOW - 2 :]), np.array(self._tips[-WINDOW:])
        made = Episodes.of_controls(
            self._navigation.anatomy,
            self._navigation.device,
            initial=proximal[0],
            control=np.diff(proximal, axis=0)[None] / DECISION_PERIOD_S,
            tip=np.concatenate([tips, tips[-1:]])[None],
        )
        return self._predictor.rollout_forward(made).tip[0, 0]
