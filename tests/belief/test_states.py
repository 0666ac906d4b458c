"""The states of a belief: what each period leads to, and how long each may last."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest

from endopilot.belief.states import TRANSITIONS, Event, State, States

EVENTS = {"t": Event.TRUSTED, "d": Event.DOUBTED, "u": Event.UNEXPLAINED, ".": None}


def names(told: str, sought: int = 100) -> str:
    """Return the first letter of the state after each period of a story, in whose first periods something is sought."""
    states, found = States(), ""
    for period, each in enumerate(told):
        states.take(EVENTS[each], seeks=period < sought)
        found += states.now[0]
    return found


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        ("t.", "ff"),
        ("dd.t", "cccf"),  # it proves itself
        ("du", "cs"),
        ("ut", "sf"),  # a copy explains the image
        ("ud", "sc"),
        ("uuuuuuu", "ssssssl"),  # copies, which take an exposure in each period, for 3 s
        ("u......", "ssssssl"),  # what explains the images, without exposures
        ("uuuuuuuu..t", "ssssssllllf"),
        ("uuuuuuud", "sssssslc"),
    ],
)
def test_a_story_leads_from_state_to_state(told: str, expected: str) -> None:
    assert names(told) == expected


@pytest.mark.parametrize(("told", "sought", "expected"), [("u.ud", 0, "lllc"), ("u..", 2, "ssl"), ("u.d", 2, "ssc")])
def test_what_is_no_longer_sought_is_lost(told: str, sought: int, expected: str) -> None:
    assert names(told, sought) == expected


def test_losses_are_counted_once_each() -> None:
    states = States()
    for each in "uuuuttduutu":
        states.take(EVENTS[each], seeks=True)
    assert states.losses == 3 and states.lost


def test_every_state_knows_what_every_image_leads_to() -> None:
    images = Event.TRUSTED, Event.DOUBTED, Event.UNEXPLAINED
    rows = {*product(State, images), (State.SEEKING, Event.SPENT)}
    assert set(TRANSITIONS) == rows


def test_the_page_shows_the_table() -> None:
    page = (Path(__file__).parents[2] / "docs/concepts/mismatch.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    shown = {row[0]: row[1:] for row in rows if len(row) == 5 and row[0] in list(State)}
    assert shown == {state: [TRANSITIONS.get((state, event), "") for event in Event] for state in State}
