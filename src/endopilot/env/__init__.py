"""Navigation as a task: what is to be reached, and when it is reached."""
