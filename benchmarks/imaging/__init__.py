"""Errors of segmentation in CT angiograms, and of tips and poses in X-ray images."""
