"""Say how good a trained run is, beside its baselines and the paper, and show it: metrics, figures, report."""
