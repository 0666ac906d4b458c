"""Stages in a row, each run in a folder of its own: the demo, a CT angiogram, a navigation."""
