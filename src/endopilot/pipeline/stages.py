"""The finished stages of a run: `Stages`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from endopilot.files import read_json, write_json
from endopilot.parallel import each


class Stages:
    """The finished stages of a run, their seconds and the rejected patients, kept in `stages.json`.

    Args:
        folder: the run's folder, which the run has claimed.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "stages.json"
        record = read_json(self._path, keys=()) if self._path.exists() else {}
        self.finished: list[str] = record.get("finished", [])
        self.seconds: dict[str, float] = record.get("seconds", {})
        self.rejected: dict[str, str] = record.get("rejected", {})

    def do(self, name: str, work: Callable[[], None]) -> None:
        """Do the work of a stage unless it is finished; time spent before an interruption counts too."""
        if name in self.finished:
            return
        start = time.perf_counter()
        try:
            work()
            self.finished.append(name)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            record = {"finished": self.finished, "seconds": self.seconds, "rejected": self.rejected}
            write_json(self._path, record)

    def do_each(self, name: str, title: str, items: Sequence[Path], work: Callable[[Path], None]) -> None:
        """Do a stage's work for every item. A bad item is rejected and recorded; a bad only item ends the run."""

        def work_on_all() -> None:
            bad = each(title, items, work)
            if len(items) == 1 and bad:
                raise bad[items[0]]
            self.rejected.update({item.name: str(error) for item, error in bad.items()})

        self.do(name, work_on_all)
