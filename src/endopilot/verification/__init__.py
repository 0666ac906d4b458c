"""The rod core against closed forms of rods without a wall, each with its equation and source."""
