"""One navigation: the loop of policy, robot and C-arm, and its record."""
