"""The agent in patients: calibration of its bands, and the choice of the ladder's patients."""
