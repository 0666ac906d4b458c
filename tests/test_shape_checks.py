"""The checks of arguments and results that every test runs under."""

from __future__ import annotations

from dataclasses import dataclass

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float

from endopilot.anatomy.distance import sample
from shape_checks import EVERY, FIRST, begin_test, checked

check = checked(typechecker=beartype)
Points = Float[np.ndarray, "n 3"]


@check
def weighted(points: Points, weights: Float[np.ndarray, "n"], *, times: int = 1) -> Points:
    """Return what is wrong where it is told to."""
    return points[:-1] if times == -1 else points * weights[:, None]


@check
@dataclass
class Line:
    points: Points
    radius: Float[np.ndarray, "n"]

    @property
    @check
    def length(self) -> float:
        return "long"

    @classmethod
    @check
    def of(cls, points: Points) -> Line:
        return cls(points, np.ones(len(points)))


@pytest.mark.parametrize(
    "call",
    [
        lambda: weighted(np.ones((4, 2)), np.ones(4)),
        lambda: weighted(np.ones((4, 3)), np.ones(5)),  # one n for both
        lambda: weighted(np.ones((4, 3)), np.ones(4), times=1.5),
        lambda: weighted(np.ones((4, 3)), np.ones(4), times=-1),  # one n for the result, too
        lambda: Line(np.ones((4, 3)), np.ones(5)),
        lambda: Line.of([[1.0, 2.0, 3.0]]),
        lambda: Line.of(np.ones((4, 3))).length,
        lambda: sample("map", np.zeros((2, 3))),  # of the package
    ],
)
def test_what_does_not_fit_is_refused(call) -> None:
    for _ in range(2):  # at the first call and at later ones
        with pytest.raises((BeartypeCallHintViolation, jaxtyping.TypeCheckError)):
            call()


def test_what_is_called_again_and_again_is_checked_at_first_and_now_and_then() -> None:
    wrong = []
    for call in range(1, FIRST + 2 * EVERY + 1):
        try:
            weighted(np.ones((4, 3)), np.ones(4), times="many")
        except BeartypeCallHintViolation:
            wrong.append(call)
    assert wrong == [*range(1, FIRST + 1), FIRST + EVERY, FIRST + 2 * EVERY]
    begin_test()
    with pytest.raises(BeartypeCallHintViolation):
        weighted(np.ones((4, 3)), np.ones(4), times="many")
