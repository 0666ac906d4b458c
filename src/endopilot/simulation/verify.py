"""Verification: the rod core against closed forms, each with its equation and source.

Every case drives the same C++ core as the product, through `simulator.run_core`, on rods of its own making.
"""
