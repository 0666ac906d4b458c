"""Compare two rules for replanning: `python -m benchmarks agent-replanning [TASK ...]`.

The ladder's `agent` keeps its course at an exposure unless the tip is lost or off course. `AlwaysReplanning` plans from
the likeliest state at every exposure. Both drive the same navigations of the ladder with the same seeds, in one
process, since processor time is measured.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from endopilot.control.agent import AgentPolicy
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.navigation.policy import Observation
from endopilot.settings import Count
from endopilot.simulation.world import NOMINAL, World, read_world
from endopilot.tasks.task import CORE, find_task
from endopilot.xray.fluoroscope import TipMeasurement

TASKS = ("crux", "circumflex", "middle-cerebral", "carotid", "diagonal")


class AlwaysReplanning(AgentPolicy):
    """The agent, but it drops its course at every exposure."""

    def _shown(self, observation: Observation) -> TipMeasurement | None:
        if observation.tip is not None:
            self._follower.begin(None)
        return super()._shown(observation)


RULES: dict[str, type[AgentPolicy]] = {"where off course": AgentPolicy, "at every exposure": AlwaysReplanning}
COLUMNS = ("safe success", "exposures", "time, s", "plans", "processor, s")


def drive(name: str, place: int, world: World, rule: type[AgentPolicy]) -> list[float]:
    """Return the figures of one navigation, as `COLUMNS` names them."""
    task, policy = find_task(name), rule()
    navigation = task.ladder_navigation(place)
    config, began = LoopConfig(simulator=replace(CORE, threads=1)), time.process_time()
    record = NavigationLoop(navigation, policy, config=config, seed=100 * task.level + place, world=world).run()
    spent = time.process_time() - began
    return [record.success and record.safe, record.exposures, record.seconds, policy.plans, spent]


def compare_replanning(tasks: tuple[str, ...] = TASKS, /, *, world: str = NOMINAL, patients: Count = 6) -> None:
    """Drive the ladder's agent by two rules for replanning, and print a table of each task and of all together.

    Args:
        tasks: of the ladder.
        world: its name or a YAML file.
        patients: of each task.
    """
    found: dict[tuple[str, str], list[list[float]]] = {}
    reality = read_world(world)
    print("| task | replans | " + " | ".join(COLUMNS) + " |\n|---|---|" + "---|" * len(COLUMNS))
    for task in (*tasks, "all"):
        for rule, policy in RULES.items():
            if task == "all":
                rows = [row for name in tasks for row in found[name, rule]]
            else:
                rows = found[task, rule] = [drive(task, place, reality, policy) for place in range(patients)]
            safe, *means = np.mean(rows, axis=0)
            cells = [f"{round(safe * len(rows))} of {len(rows)}", *(f"{mean:.1f}" for mean in means)]
            print(f"| {task} | {rule} | " + " | ".join(cells) + " |", flush=True)
