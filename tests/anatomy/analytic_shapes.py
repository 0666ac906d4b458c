"""Analytic lumens for the anatomy tests: those that `python -m benchmarks anatomy` measures on."""

from benchmarks.anatomy.analytic_lumens import BEND_MM, forked_tree, mask_of, torus_distance, tree_distance

__all__ = ["BEND_MM", "forked_tree", "mask_of", "torus_distance", "tree_distance"]
