"""Segmentation methods: each module holds one, as a function `segment_lumen(volume, config)`."""
