"""Errors of centerlines, section names and ostia, and vessels' shapes beside the atlas'."""
