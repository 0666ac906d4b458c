"""Programs that others made, each in an environment of its own, which judge ours on the same input."""
