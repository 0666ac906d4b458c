"""What is said of many places of a vessel: the longest one by one, the rest together."""

from __future__ import annotations

from collections.abc import Sequence

MOST_LISTED = 8  # as many places or pieces are listed one by one
NOTED_MM = 5.0  # what is left out or widened gets a remark of its own from this length on


def longest_first(found: Sequence[tuple[float, str]], rest: str) -> list[str]:
    """Return remarks, given with lengths, mm, the longest first, and one on all others if they are long together: its
    text `rest` has braces for their number and length."""
    order = sorted(found, key=lambda remark: -remark[0])
    told = [text for length, text in order[:MOST_LISTED] if length >= NOTED_MM]
    left = sum(length for length, _ in order[len(told) :])
    return told + ([rest.format(len(order) - len(told), left)] if left >= NOTED_MM else [])
