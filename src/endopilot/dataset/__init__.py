"""Datasets of simulated navigations in the LeRobot v3 layout: made, split and read here."""
