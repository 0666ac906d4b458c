"""`take_image` and `endopilot xray`: what is shown, and what it cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.errors import InputError, Remark
from endopilot.types import Volume
from endopilot.xray.image import XrayImager
from endopilot.xray.take_image import TakeImageConfig, take_image


def shown(fork, **changes):
    return take_image(fork, config=TakeImageConfig(view_deg=(0.0, 0.0), inserted_length_mm=12.0, **changes))


def darker(image, row: int, column: int) -> float:
    """Return by how much a small square is darker than the image."""
    square = image.grey[row - 1 : row + 2, column - 1 : column + 2]
    return float(np.median(image.grey)) - float(square.mean())


def test_fluoroscopy_shows_the_wire_to_its_tip(fork):
    """The straight wire lies along z: above its tip there is no wire, 5 mm below it there is."""
    image = shown(fork, dose=10.0)
    row, column = np.rint(image.tip_pixel).astype(int)
    below = row + round(5.0 / image.mm_per_pixel)
    darkest = max(darker(image, below, column + side) for side in range(-4, 5))
    assert darkest > 30 > 10 > darker(image, row - 10, column)
    assert (image.frames, image.air_kerma_ugy > 0) == (1, True)


def test_dsa_and_roadmap_show_the_vessel_and_take_two_frames(fork):
    plain, dsa, roadmap = (shown(fork, show=kind, dose=4.0) for kind in ("fluoroscopy", "dsa", "roadmap"))
    row, column = np.rint(plain.tip_pixel).astype(int)
    place = row - round(10.0 / plain.mm_per_pixel), column  # in the vessel, ahead of the wire
    assert darker(dsa, *place) > 10
    assert darker(roadmap, *place) < darker(plain, *place) - 10
    assert (dsa.frames, roadmap.frames) == (2, 2)
    assert dsa.air_kerma_ugy == pytest.approx(2 * plain.air_kerma_ugy)


@pytest.mark.parametrize("shift_mm", [(-250.0, 0.0, 0.0), (0.0, 0.0, 90.0), (0.0, -33.0, 33.0)])
def test_a_ct_of_another_place_is_refused_with_both_boxes(fork, shift_mm):
    points = np.concatenate([branch.centerline.points for branch in fork.tree.branches])
    low, high = points.min(axis=0) - 5.0, points.max(axis=0) + 5.0
    voxels = np.full(np.ceil((high - low) / 2.0).astype(int)[::-1] + 1, 40, dtype=np.int16)
    there = Volume(voxels, np.full(3, 2.0), low, np.eye(3))
    XrayImager(fork, "workhorse-014", ct=there)
    with pytest.raises(InputError, match=r"^ct: the CT spans x .* mm; .*% of the vessel .* \(x .*\) lies outside"):
        XrayImager(fork, "workhorse-014", ct=replace(there, origin_mm=low + shift_mm))
    with pytest.warns(Remark, match=r"[1-4]?\d% of the vessel"):
        XrayImager(fork, "workhorse-014", ct=replace(there, voxels=voxels[3:], origin_mm=low + np.array([0, 0, 8.5])))


def test_a_breath_moves_vessel_and_wire_in_the_image(fork):
    """Two seconds into a breath the vessel lies 4.9 mm nearer to the feet: lower in a view from the front."""
    plain, inspired = shown(fork, dose=10.0), shown(fork, dose=10.0, motion="breathing", time_s=2.0)
    down = inspired.tip_pixel[0] - plain.tip_pixel[0]
    assert down * plain.mm_per_pixel == pytest.approx(4.9, abs=0.5)
    row, column = np.rint(inspired.tip_pixel).astype(int)
    below = row + round(5.0 / plain.mm_per_pixel)
    assert max(darker(inspired, below, column + side) for side in range(-4, 5)) > 30
    assert shown(fork, motion="breathing").tip_pixel == pytest.approx(plain.tip_pixel, abs=0.5)


def test_a_catheter_is_shown_up_to_its_own_tip(fork, monkeypatch):
    """The line that both share, cut at each tip, ends where the core has the tips."""
    seen = {}
    signal = XrayImager.signal
    monkeypatch.setattr(XrayImager, "signal", lambda *given, **how: seen.update(how) or signal(*given, **how))
    for deep in (7.0, 14.0):  # behind the wire's tip, at 12 mm, and ahead of it
        image = shown(fork, catheter=("microcatheter-1.7f",), catheter_inserted_length_mm=deep)
        (line,) = seen["catheters"]
        assert line[0, 2] == pytest.approx(deep, abs=0.3)
        assert np.linalg.norm(image.tip_pixel - shown(fork).tip_pixel) * image.mm_per_pixel < 1.0
