"""Real robots beside the simulated one."""
