"""The agent: plans, robots, and advice on X-ray."""
