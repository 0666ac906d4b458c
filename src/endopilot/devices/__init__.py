"""Devices as data: wires, catheters, and stacks of them."""
