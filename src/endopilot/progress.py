"""A progress bar with the time left, for work that may take more than two seconds."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


@runtime_checkable
class Advance(Protocol):
    """What `progress` yields: call it with the number of units done since the last call and, if useful, a remark."""

    def __call__(self, amount: int | float = 1, remark: str = "") -> None:
        """Advance the bar by `amount` units."""
        ...


_shown = False  # whether a bar is shown


@contextmanager
def progress(title: str, total: int | float) -> Iterator[Advance]:
    """Show a bar of `total` units of work on standard error while the block runs, but not within another; without a
    terminal, one line at the end of work that took more than two seconds."""
    global _shown
    console = Console(stderr=True)
    outermost, _shown = not _shown, True
    bar = Progress(
        TextColumn("{task.description:<28}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[remark]}", markup=False),
        console=console,
        disable=not (outermost and console.is_terminal),
    )
    try:
        with bar:
            task = bar.add_task(title, total=total, remark="")

            def advance(amount: int | float = 1, remark: str = "") -> None:
                bar.update(task, advance=amount, remark=remark)

            yield advance
            elapsed = bar.tasks[task].elapsed or 0.0
    finally:
        _shown = not outermost
    if outermost and not console.is_terminal and elapsed > 2:
        console.print(f"{title}: done in {elapsed:.1f} s", highlight=False, markup=False)


def silence() -> None:
    """Show no bar from now on; for worker processes, whose parent shows one."""
    global _shown
    _shown = True
