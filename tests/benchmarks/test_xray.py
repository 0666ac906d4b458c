"""How the figures of X-ray detection are counted."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.imaging.scenes import SceneConfig, draw_scenes
from benchmarks.imaging.wires import Search, figures_of
from benchmarks.imaging.xray import BARS, Exposure, _figures
from endopilot.errors import InputError


def exposure(**changes) -> Exposure:
    usual = {"views": 2, "dose": 1.0, "contrast": 0.0, "angle": "RAO 30", "wire": True, "found": True}
    errors = {"along_px": 1.0, "across_px": 0.2, "along_mm": 0.3, "space_mm": 0.4, "deviations": 1.0}
    return Exposure(**(usual | errors | changes))


def test_a_tip_found_elsewhere_is_missed_and_one_found_without_a_wire_is_a_false_alarm():
    rows = [
        exposure(),
        exposure(along_px=3.0),
        exposure(along_px=8.0, across_px=7.0, deviations=9.0),
        exposure(found=False, along_px=np.nan),
        exposure(dose=4.0, along_px=99.0),
        exposure(views=1, along_px=5.0),
        exposure(wire=False),
        exposure(wire=False, found=False),
    ]
    motions = [{"mean": 1.0, "measured": None}, {"mean": 0.5, "measured": 0.1}]
    registrations = [
        {"two_views_mm": value, "one_view_mm": [1.0, 3.0], "motion_mm": motion}
        for value, motion in zip((0.2, 0.9), motions, strict=True)
    ]
    figures = _figures(rows, registrations, [20.0, 30.0, 10.0])
    assert figures["missed_share"] == 0.5 and figures["images"] == 4
    assert figures["tip_along_median_px"] == 3.0
    assert figures["inside_own_95_share"] == pytest.approx(2 / 3)
    assert figures["one_view"]["tip_along_median_px"] == 5.0
    assert figures["by"]["dose 4, contrast 0"]["missed_share"] == 1.0
    assert figures["false_alarms_share"] == 0.5
    assert figures["registration_error_mm"] == pytest.approx(0.55)
    assert figures["motion_error_mm"] == 0.1 and figures["motions_not_measured"] == 1
    assert figures["motion_error_of_published_mean_mm"] == 0.75
    assert figures["passed"] == {
        name: name
        not in ("tip_along_median_px", "missed_share", "registration_error_mm", "registration_error_one_view_mm")
        for name in BARS
    }
    assert figures["images_per_second"] == 20.0


def test_anatomies_of_ones_own_lie_on_the_table(fork, vessel, tmp_path):
    (scene,) = draw_scenes(SceneConfig(given=(vessel,)))
    assert scene.anatomy.identity == fork.identity
    with pytest.raises(InputError, match="no such folder"):
        next(draw_scenes(SceneConfig(given=(tmp_path / "absent",))))


def test_what_is_wrong_counts_as_said_unless_it_is_called_found():
    def search(status: str, **changes) -> Search:
        return Search(**vars(exposure(found=status != "not found", **changes)), said=status, patient="rca")

    far = {"along_px": 50.0, "deviations": 9.0}
    rows = [
        search("found"),
        search("found", **far),
        search("ambiguous"),
        search("ambiguous", **far),
        search("not found", views=1),
        search("found", views=1, along_px=2.0, deviations=5.0),
        search("ambiguous", wire=False),
        search("not found", wire=False),
    ]
    figures = figures_of(rows)
    assert figures["missed_share"] == 0.5 and figures["missed_share_one_view"] == 0.5
    assert figures["wrong"] == 4 and figures["said_share"] == 0.75
    assert figures["doubted_share"] == pytest.approx(1 / 3)
    assert figures["surely_wrong_share"] == pytest.approx(1 / 6)
    assert figures["inside_own_95_share"] == pytest.approx(1 / 3)
    assert figures["false_alarms_share"] == 0.5
    assert figures["by"]["rca"]["wires"] == 4
