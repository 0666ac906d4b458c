"""`endopilot evaluate`: trained run -> errors beside the paper's and the baselines'."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from endopilot.cli.arguments import Answer, Existing, Figures, OutputFolder
from endopilot.evaluation.evaluate import EvaluateConfig, evaluate
from endopilot.evaluation.results import FIGURES_FOLDER, METRICS_FILE, REPORT_FILE, RESULTS_FILE
from endopilot.report.report_text import mean_errors


def command(
    run: Positional[Path],
    /,
    *,
    output: OutputFolder,
    dataset: Existing | None = None,
    other_seeds: tuple[Path, ...] = (),
    config: EvaluateConfig = EvaluateConfig(),
) -> Answer:
    """Roll the networks of a run out in open loop (protocols P1 to P4) and measure their errors.

    Args:
        run: folder made by `endopilot train`, or `wires`, the simulated wires.
        output: folder of report.html, metrics.json, figures and tables.
        dataset: dataset to evaluate on; the one that the run was trained on if not given.
        other_seeds: runs of the same training with other seeds; their errors in P1 are reported beside the run's, with
            mean and standard deviation.
    """
    from endopilot.report.report import report_evaluation  # matplotlib and plotly are slow to import

    metrics = evaluate(run, output=output, config=config, dataset=dataset, other_seeds=other_seeds)
    report_evaluation(output)
    shown: list[Figures | str] = []
    for split, record in metrics["splits"].items():
        counts = f"{record['episodes']} navigations, patients: {len(record['anatomies'])}"
        shown.append(f"{record['title']} ({split}; {counts}): mean absolute error, mm, by s after the given states")
        shown.append(mean_errors(metrics, split))
    names = {"report": REPORT_FILE, "figures": FIGURES_FOLDER, "metrics": METRICS_FILE, "predictions": RESULTS_FILE}
    files = {name: output / file for name, file in names.items()}
    return Answer(metrics, [*shown, {"findings": metrics["findings"], **files}])
