"""Segmentation methods: each module here is one, named after it, and holds `segment_lumen(volume, config)`."""
