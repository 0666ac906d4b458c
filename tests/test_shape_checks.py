"""The checks of arguments and results that every test runs under."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float

from endopilot.anatomy.distance import sample
from shape_checks import EVERY, FIRST, begin_test, checked

if TYPE_CHECKING:
    from nowhere import Unknown

check = checked(typechecker=beartype)
Points = Float[np.ndarray, "n 3"]


@check
def weighted(points: Points, weights: Float[np.ndarray, "n"], *, times: int = 1) -> Points:
    """Return what is wrong where it is told to."""
    return points[:-1] if times < 0 else points * weights[:, None]


@check
@dataclass
class Line:
    points: Points
    radius: Float[np.ndarray, "n"]

    @check
    def first(self, count: int) -> Points:
        return self.points[:count]

    @property
    @check
    def length(self) -> float:
        return "long"

    @classmethod
    @check
    def of(cls, points: Points) -> Line:
        return cls(points, np.ones(len(points)))


@check
def rows(points: Points, weights: Float[np.ndarray, "n"]) -> Iterator[np.ndarray]:
    yield from points


@check
def unknown(value: Unknown, count: int) -> int:
    return count


@check
def outer(points: Points) -> Points:
    weighted(np.zeros((7, 3)), np.zeros(7))  # its n is another
    return points


def test_what_fits_passes() -> None:
    points = np.ones((4, 3))
    assert weighted(points, np.full(4, 2.0)).sum() == 24.0
    assert Line.of(points).first(2).shape == (2, 3) and outer(points) is points
    assert len(list(rows(points, np.ones(4)))) == 4 and unknown("anything", 3) == 3


@pytest.mark.parametrize(
    "call",
    [
        lambda: weighted(np.ones((4, 2)), np.ones(4)),
        lambda: weighted(np.ones((4, 3)), np.ones(5)),  # one n for both
        lambda: weighted(np.ones((4, 3), dtype=int), np.ones(4)),
        lambda: weighted(np.ones((4, 3)), np.ones(4), times=1.5),
        lambda: weighted(np.ones((4, 3)), np.ones(4), times=-1),  # one n for the result, too
        lambda: Line(np.ones((4, 3)), np.ones(5)),
        lambda: Line.of([[1.0, 2.0, 3.0]]),
        lambda: Line.of(np.ones((4, 3))).first("2"),
        lambda: Line.of(np.ones((4, 3))).length,
        lambda: rows(np.ones((4, 3)), np.ones(5)),  # before it begins
        lambda: unknown("anything", "3"),
        lambda: sample("map", np.zeros((2, 3))),  # of the package
    ],
)
def test_what_does_not_fit_is_refused(call) -> None:
    for _ in range(2):  # at the first call and at later ones
        with pytest.raises((BeartypeCallHintViolation, jaxtyping.TypeCheckError)):
            call()


def test_the_package_is_checked_in_this_way() -> None:
    assert sample._is_checked and sample.__module__ == "endopilot.anatomy.distance"


def test_what_is_called_again_and_again_is_checked_at_first_and_now_and_then() -> None:
    wrong = []
    for call in range(1, FIRST + 2 * EVERY + 1):
        try:
            unknown(0, "many")
        except BeartypeCallHintViolation:
            wrong.append(call)
    assert wrong == [*range(1, FIRST + 1), FIRST + EVERY, FIRST + 2 * EVERY]
    begin_test()
    with pytest.raises(BeartypeCallHintViolation):
        unknown(0, "many")
