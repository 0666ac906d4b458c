"""Long work in a thread of its own, for which decisions wait no longer than they may: `Thought`, and its `Budget`."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import Step

Found = TypeVar("Found")
_CALL = 4000
"""Evaluations of nodes that take as long as what a call of the core takes besides, about 0.5 ms."""


class Pace(NamedTuple):
    """What a decision grants work that takes longer than a decision may.

    Attributes:
        evaluations: of nodes (Newton's iterations times active nodes) that it waits for.
        seconds: that it waits instead, s; the work then goes on without it, and its bits do not repeat.
    """

    evaluations: float | int = np.inf
    seconds: float | None = None


class OutOfBudgetError(Exception):
    """A search has spent its budget."""


class CancelledError(Exception):
    """Nobody waits any more."""


class Budget:
    """What a search may spend, by which it ends whatever it is at: all that it does is to simulate.

    What works in a thread of its own waits, too, until a decision grants what it spends next (`Thought`).

    Attributes:
        over: whether it is spent.
        spent: evaluations of nodes that it took since it began.
        worked_s: time that it took since it began, s, less that in which it waited.
    """

    def __init__(self, seconds: float = np.inf, evaluations: float | int = np.inf) -> None:
        """Give a budget.

        Args:
            seconds: time at work, s.
            evaluations: of nodes (Newton's iterations times active nodes): by them alone the bits of a search repeat.
        """
        self._seconds, self._evaluations = seconds, evaluations
        self._turn, self._granted, self._cancelled = threading.Condition(), np.inf, False
        self.begin()

    def begin(self, granted: float = np.inf) -> None:
        """Begin anew; what is not granted has to be waited for."""
        self.over, self.spent, self.worked_s, self._resumed_s = False, 0.0, 0.0, time.perf_counter()
        self._granted, self._cancelled, self._ended = granted, False, False

    def spend(self, evaluations: float | int) -> None:
        """Take some evaluations off, and wait where they are more than is granted.

        Raises:
            OutOfBudgetError: nothing is left.
            CancelledError: nobody waits any more.
        """
        self.worked_s += time.perf_counter() - self._resumed_s
        self.spent += evaluations
        if self.spent > self._evaluations or self.worked_s > self._seconds:
            self.over = True
            raise OutOfBudgetError
        with self._turn:
            self._turn.notify_all()
            self._turn.wait_for(lambda: self.spent < self._granted or self._cancelled)
            if self._cancelled:
                raise CancelledError
        self._resumed_s = time.perf_counter()

    def simulated(self, simulator: Simulator, step: Step) -> None:
        """Take a step of the rod core off."""
        self.spend(simulator.evaluations(step) + _CALL)

    def grant(self, evaluations: float | int, seconds: float | None) -> None:
        """Let the work in another thread spend more, and wait until it has, or has ended, or some time is over, s."""
        with self._turn:
            self._granted += evaluations
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._ended or self.spent >= self._granted, timeout=seconds)

    def end(self) -> None:
        """Tell who waits that the work has ended."""
        with self._turn:
            self._ended = True
            self._turn.notify_all()

    def cancel(self) -> None:
        """End the work in another thread: nobody waits any more."""
        with self._turn:
            self._cancelled = True
            self._turn.notify_all()


class Thought(Generic[Found]):
    """Works something out in a thread of its own, for which each decision waits no longer than it may.

    Where each decision grants a number of evaluations, the thread waits for them, and the bits repeat; where a decision
    waits for some seconds, they do not. The thread ends where nobody holds the thought any more.

    Attributes:
        busy: whether it goes on.
    """

    def __init__(
        self,
        work: Callable[[Callable[[Found], None]], Found],
        budget: Budget,
        pace: Pace,
    ) -> None:
        """Begin.

        Args:
            work: what is worked out; it is given what to call with the answer as far as it is known.
            budget: that the work takes off.
            pace: what each decision grants of it.
        """
        self.busy, self._granted, self._seconds = True, pace.evaluations, pace.seconds
        budget.begin(granted=0.0)
        self._budget, self._at = budget, SimpleNamespace(found=None, error=None, ended=False)
        self._thread = threading.Thread(target=_think, args=(work, budget, self._at), daemon=True)
        self._thread.start()
        weakref.finalize(self, _end, budget, self._thread)

    @property
    def found(self) -> Found | None:
        """The answer as far as it is known; None if nothing of it is."""
        return self._at.found

    def wait(self) -> None:
        """Let it go on for a decision; what fails in it is raised here."""
        self._budget.grant(self._granted if self._seconds is None else np.inf, self._seconds)
        self.busy = not self._at.ended
        if self._at.error is not None:
            raise self._at.error

    def stop(self) -> None:
        """End it: what it was begun from is no longer believed."""
        _end(self._budget, self._thread)
        self.busy = False


def _think(work: Callable[..., object], budget: Budget, at: SimpleNamespace) -> None:
    """Work in a thread, which does not hold the thought."""
    try:
        at.found = work(lambda found: setattr(at, "found", found))
    except CancelledError:
        pass
    except Exception as error:  # raised where it is waited for
        at.error = error
    at.ended = True
    budget.end()


def _end(budget: Budget, thread: threading.Thread) -> None:
    """End the work in a thread, and wait until it has."""
    budget.cancel()
    if threading.current_thread() is not thread:
        thread.join()
