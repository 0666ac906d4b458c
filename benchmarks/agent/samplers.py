"""Compare what a search tries where a straight push fails: `python -m benchmarks agent-samplers [VERSION ...]`.

Three samplers search courses for the same navigations, from the same beliefs, with the same budget of evaluations of
nodes. `grid`: places and rotations evenly. `near the best`: drawn evenly, then around the best so far, each time from
where the devices are (the cross-entropy method, with elites). `own`: the package's table.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from benchmarks.figures import markdown_table
from endopilot.belief.belief import Belief
from endopilot.belief.thought import Budget
from endopilot.control.agent_config import AgentConfig
from endopilot.control.repertoire import Repertoire, Row, Table, read_table
from endopilot.control.search import Search
from endopilot.ladder.attempt import navigation_seed
from endopilot.progress import progress
from endopilot.settings import Count, Within
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route
from endopilot.tasks.task import list_tasks

COLUMNS = ("tasks", "sampler", "reached", "10⁶ evaluations: mean", "median", "largest")
_GRID = Row(at=(-1.0,), turns=32), Row(turns=32), Row(turns=32, back=(1.5, 3.0))
_NEAR = Row(at=(-4.0, 3.0), turns=32, back=(0.0, 4.0), rounds=12, agree=0.5)


def tables() -> dict[str, Table]:
    """Return the samplers that are compared, by name; they differ for wires alone."""
    own = read_table()

    def changed(rows: tuple[Row, ...], drawn: tuple[Row, ...]) -> Table:
        def of(given: Repertoire) -> Repertoire:
            kept = {name: getattr(given, name) for name in ("force", "slack_mm", "slack_widths", "agree")}
            return Repertoire(rows=(given.rows[0], *rows), drawn=drawn, **kept)

        alone = {kind: of(each) for kind, each in own.items() if kind in ("wire", "wire in a wide lumen")}
        return {**own, **alone}

    return {"grid": changed(_GRID, ()), "near the best": changed((), (_NEAR,)), "own": own}


def search(navigation: Navigation, table: Table, *, evaluations: int, seed: int) -> tuple[float, float]:
    """Return which share of the wires a course brings to the target, and evaluations of nodes that the search took."""
    config, budget = AgentConfig.of(navigation), Budget(evaluations=evaluations)
    belief = Belief(navigation, Belief.around(config.belief), config.belief)
    route = Route.to(navigation.anatomy, navigation.target)
    searched = Search(navigation, route, belief, config=config.search, seed=seed, budget=budget, table=table)
    return searched.find(belief, seconds=navigation.seconds).reached, budget.spent


def compare_samplers(
    versions: tuple[str, ...] = ("2",),
    /,
    *,
    patients: Count = 4,
    evaluations: Annotated[int, Within(1, 10**15)] = 300_000_000,
) -> None:
    """Search courses for navigations by three samplers, and print a table.

    Args:
        versions: of the ladder, or folders of a benchmark's tasks; their navigations are those of a wire alone.
        patients: of each task, from the first on.
        evaluations: of nodes, at most, in a search.
    """
    rows = []
    for version in versions:
        tasks = list_tasks(int(version) if version.isdigit() else Path(version))
        places = [(task, place) for task in tasks for place in range(min(patients, len(task.ladder.numbers)))]
        for name, table in tables().items():
            found = []
            with progress(f"{version}, {name}", len(places)) as advance:
                for task, place in places:
                    seed = navigation_seed(task, place)
                    found.append(search(task.ladder_navigation(place), table, evaluations=evaluations, seed=seed))
                    advance()
            reached, spent = np.array(found).T
            millions = (f"{each / 1e6:.0f}" for each in (spent.mean(), np.median(spent), spent.max()))
            rows.append((Path(version).name, name, f"{(reached > 0.5).sum()} of {len(reached)}", *millions))
    print("\n".join(markdown_table(COLUMNS, rows)))
