"""Navigation as a task: which wire is to reach which target in which vessel, and the twelve tasks of the ladder."""
