"""`endopilot dataset`: anatomies -> many random navigations on disk."""

from __future__ import annotations

from tyro.conf import Positional

from endopilot.cli.arguments import Existing, Figures, OutputFolder
from endopilot.dataset.config import DatasetConfig
from endopilot.devices.robot import read_robot
from endopilot.devices.stack import Stack
from endopilot.files import read_json
from endopilot.simulation.world import NOMINAL, read_world


def command(
    anatomies: Positional[tuple[Existing, ...]],
    /,
    *,
    output: OutputFolder,
    device: str = "workhorse-014",
    catheter: tuple[str, ...] = (),
    robot: str | None = None,
    world: str = NOMINAL,
    scheduler: str | None = None,
    config: DatasetConfig = DatasetConfig(),
) -> Figures:
    """Simulate random navigations of many patients and store them as a LeRobot v3 dataset.

    Each catheter is driven at random and independently. An interrupted run goes on where it stopped when the same
    command is given again.

    Args:
        anatomies: folders made by `endopilot anatomy` or `endopilot atlas`.
        output: folder of the dataset.
        robot: name of a robot (docs/concepts/robot.md) or a YAML file that makes the motions, and measures them; if not
            given, they are made as drawn.
        world: name of the world that reality is (docs/concepts/worlds.md), or a YAML file.
    """
    from endopilot.dataset.generate import generate_dataset  # an extra brings its libraries; --help needs none

    generate_dataset(
        anatomies,
        output=output,
        device=Stack.of(device, *catheter),
        config=config,
        robot=None if robot is None else read_robot(robot),
        world=read_world(world),
        scheduler=scheduler,
    )
    info = read_json(output / "meta" / "info.json")
    return {"dataset": output, "episodes": info["total_episodes"], "samples": info["total_frames"]}
