"""Imaging: from a CT angiogram to the mask of one vessel's lumen. Entry: `endopilot.imaging.segment.segment`."""
