"""Draws cards of all tasks, with the agent on its way, for docs/concepts/tasks.md: `python docs/figures/cards.py`."""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parents[1]
sys.path.append(str(DOCS.parent))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.control.agent import AgentPolicy
from endopilot.env.exposures import Picture
from endopilot.ladder.attempt import navigation_seed
from endopilot.ladder.terms import Terms
from endopilot.navigation.loop import NavigationLoop
from endopilot.progress import progress
from endopilot.tasks.task import LadderVersion, Task, list_tasks

FRAME_MS, MOST_FRAMES, COLOURS = 125, 48, 16
"""Time that a picture is shown, pictures at most, and colours: some 60 kB a task."""


def card(task: Task, version: LadderVersion) -> list[str]:
    """Drive the agent in a task's first patient, write the moving picture, and return the card's lines."""
    navigation, terms = task.ladder_navigation(0), Terms(version)
    loop = NavigationLoop(
        navigation, AgentPolicy(), config=terms.loop, seed=navigation_seed(task, 0), world=terms.world
    )
    picture = Picture(navigation)
    frames = [picture.of(loop.simulator, 0)]
    while loop.reason is None:
        loop.step()
        frames.append(picture.of(loop.simulator, 0))
    every = -(-len(frames) // MOST_FRAMES)
    shown = [Image.fromarray(frame) for frame in [*frames[::every], *8 * frames[-1:]]]
    first = shown[-1].quantize(COLOURS)
    path = DOCS / "images" / "tasks" / f"{task.name}.gif"
    path.parent.mkdir(exist_ok=True)
    paletted = [frame.quantize(palette=first, dither=Image.Dither.NONE) for frame in shown]
    paletted[0].save(path, save_all=True, append_images=paletted[1:], duration=FRAME_MS, loop=0, optimize=True)
    where = f", {task.depth_mm:g} mm deep" if task.depth_mm else ", its middle"
    facts = f"Target: section {task.section}{where}, for the {task.arrives or 'wire'}. {navigation.stack.name}"
    facts += f"; {navigation.seconds:g} s, {navigation.force_limit_n:g} N on the wall."
    head = f"## {task.name.title()}-v2"
    return [head, "", f"{task.title.capitalize()}. {facts}", "", f"![{task.name}](../images/tasks/{path.name})", ""]


if __name__ == "__main__":
    versions: tuple[LadderVersion, ...] = (2, "coaxial")
    tasks = [(task, version) for version in versions for task in list_tasks(version)]
    lines = []
    with progress("Cards", len(tasks)) as advance:
        for task, version in tasks:
            lines += card(task, version)
            advance()
    fill("concepts/tasks.md", "cards", lines, dated=False)
