"""Synthetic patients: vessel trees drawn from published statistics."""
