"""A search that goes on while the devices move: `Planner`."""

from __future__ import annotations

import threading
import time
import weakref

from endopilot.belief.belief import Belief
from endopilot.control.course import Course
from endopilot.control.search import Search
from endopilot.control.trials import CancelledError


class Planner:
    """Searches in a thread of its own, for which each decision waits no longer than it may.

    What the search has found so far can be driven while it goes on. Where each decision grants the search a number of
    evaluations, the thread waits for them, and the bits repeat; where it waits for some seconds, it does not.

    Attributes:
        search: that it leads.
        busy: whether the search goes on.
        worked_s: processor time of all its searches, s.
    """

    def __init__(self, search: Search, *, evaluations: float | int, seconds: float | None) -> None:
        """Take a search.

        Args:
            search: that is led.
            evaluations: of nodes that each decision grants, see `Budget`.
            seconds: that each decision waits at most, s: the search goes on without it then, and needs no grants.
        """
        self.search, self.busy, self.worked_s = search, False, 0.0
        self._granted, self._seconds = evaluations if seconds is None else float("inf"), seconds

    def begin(self, belief: Belief, *, seconds: float, horizon_mm: float) -> None:
        """Begin to search from where the likeliest devices are; the arguments are those of `Search.find`."""
        self.cancel()
        self.search.budget.begin(0.0)
        self.search.set_out(belief, seconds=seconds, horizon_mm=horizon_mm)
        self.busy, self._work = True, _Work(self.search)
        self._work.start()
        weakref.finalize(self, self._work.stop)

    def wait(self) -> Course | None:
        """Let the search go on for a decision; return the course as far as it has found one, None if none yet."""
        self.search.budget.grant(self._granted, self._seconds)
        if self._work.ended:
            self._end()
        return self._work.found

    def cancel(self) -> None:
        """End the search: what it was begun from is no longer believed."""
        if self.busy:
            self._work.stop()
            self._end()

    def _end(self) -> None:
        self.busy, self.worked_s = False, self.worked_s + self._work.took_s
        if self._work.error is not None:
            raise self._work.error


class _Work(threading.Thread):
    """The thread; it does not hold the planner, with which it ends where nobody holds that any more.

    Attributes:
        found: the course as far as it is known.
        error: what the search raised.
        ended, took_s: whether it is over, and the processor time that it took, s.
    """

    def __init__(self, search: Search) -> None:
        super().__init__(daemon=True)
        self._search, self.ended, self.took_s = search, False, 0.0
        self.found: Course | None = None
        self.error: Exception | None = None

    def run(self) -> None:
        began_s = time.thread_time()
        try:
            self.found = self._search.go_on(found=self._note)
        except CancelledError:
            pass
        except Exception as error:  # raised where the search is waited for
            self.error = error
        self.took_s, self.ended = time.thread_time() - began_s, True
        self._search.budget.end()

    def stop(self) -> None:
        """End the search, and wait until it has."""
        self._search.budget.cancel()
        if threading.current_thread() is not self:
            self.join()

    def _note(self, course: Course) -> None:
        self.found = course
