"""The rod core beside closed forms and an independent engine."""
