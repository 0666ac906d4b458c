"""Angiograms of one's own patients, with the truth beside each frame: `make_angiograms`."""
