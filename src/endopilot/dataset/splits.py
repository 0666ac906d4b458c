"""Which episodes train, which calibrate and which test: fixed by hash, not by chance or order.

Two splits are nested. By anatomy, whole patients go to train, calibrate or test, so that no data of a test
patient are used before. Within the train patients, some navigations are held out as `seen_test`: new controls on
known vessels, the paper's likely reading of its 80/20 split.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Shaped

from endopilot.errors import InputError

SPLITS = ("train", "seen_test", "calibrate", "test")
DEFAULT_ANATOMY_SHARES = (0.6, 0.2, 0.2)
"""Shares of the anatomies that train, calibrate and test."""


def assign_splits(
    names: Sequence[str],
    n_sequences: int,
    *,
    anatomy_shares: tuple[float, float, float] | None = None,
    seen_test_share: float = 0.2,
) -> Shaped[np.ndarray, "anatomies sequences"]:
    """Return the split of every sequence of every anatomy, one of `SPLITS`.

    Anatomies are ranked by the SHA-256 of their name and dealt out by counts, so that the shares are met as closely
    as few patients allow; sequences likewise by the SHA-256 of "name/index". Neither a seed nor the order of `names`
    matters.

    Args:
        anatomy_shares: shares of train, calibrate and test. None means 0.6, 0.2, 0.2, and for a single anatomy, which
            cannot be divided, a split by sequence alone.
        seen_test_share: share of the sequences of a train anatomy that are held out as `seen_test`.

    Raises:
        InputError: too few anatomies for the requested splits, or too few sequences.
    """
    if anatomy_shares is None:
        anatomy_shares = (1.0, 0.0, 0.0) if len(names) == 1 else DEFAULT_ANATOMY_SHARES
    counts = _counts(len(names), anatomy_shares)
    order = sorted(range(len(names)), key=lambda i: _digest(names[i]))
    by_anatomy = np.empty(len(names), dtype="<U9")
    by_anatomy[order] = np.repeat(np.array(["train", "calibrate", "test"]), counts)

    splits = np.repeat(by_anatomy[:, None], n_sequences, axis=1)
    held_out = _held_out(n_sequences, seen_test_share) if counts[0] else 0
    for row, name in enumerate(names):
        if by_anatomy[row] == "train":
            ranked = sorted(range(n_sequences), key=lambda i: _digest(f"{name}/{i}"))
            splits[row, ranked[:held_out]] = "seen_test"
    return splits


def _counts(n: int, shares: tuple[float, float, float]) -> list[int]:
    """Turn shares into counts: one for each positive share, the rest by the largest shortfall (first split first)."""
    wanted = [share > 0 for share in shares]
    if n < sum(wanted):
        raise InputError(
            f"anatomy_shares: {n} anatomies cannot fill {sum(wanted)} splits (train, calibrate, test = {shares}); "
            f"give at least {sum(wanted)} anatomies or set a share to 0"
        )
    counts = [int(share) for share in wanted]
    while sum(counts) < n:
        shortfall = [n * share - count for share, count in zip(shares, counts, strict=True)]
        counts[shortfall.index(max(shortfall))] += 1
    return counts


def _held_out(n_sequences: int, share: float) -> int:
    """Return how many of the sequences are held out: the rounded share, but at least one, and never all."""
    if share == 0:
        return 0
    if n_sequences < 2:
        raise InputError(
            f"sequences: {n_sequences} cannot be split into train and seen_test; "
            "give at least 2 or set seen_test_share to 0"
        )
    return min(max(round(n_sequences * share), 1), n_sequences - 1)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode()).digest()
