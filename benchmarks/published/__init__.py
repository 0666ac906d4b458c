"""Published bench tests of wires and catheters, simulated."""
