"""`endopilot evaluate`: trained run -> errors beside the paper's and the baselines'."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import OutputFolder, existing, show
from endopilot.evaluation.evaluate import EvaluateConfig, evaluate


def command(
    run: Positional[Path],
    /,
    *,
    output: OutputFolder,
    dataset: Path | None = None,
    other_seeds: tuple[Path, ...] = (),
    json: bool = False,
    config: EvaluateConfig = EvaluateConfig(),
) -> None:
    """Roll the networks of a run out open loop (protocols P1 to P4) and measure their errors.

    Args:
        run: folder made by `endopilot train`, or `pretrained`, the causal model that comes with endopilot.
        output: folder of metrics.json, figures and tables.
        dataset: dataset to evaluate on; the one that the run was trained on if not given.
        other_seeds: runs of the same training with other seeds; their errors in P1 stand beside the run's, with mean
            and standard deviation.
        json: print the figures as JSON.
        config: what to evaluate.
    """
    show(evaluate(run, output, config, existing(dataset) if dataset else None, other_seeds), as_json=json)
