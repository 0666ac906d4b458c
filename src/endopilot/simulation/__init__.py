"""From an anatomy and proximal controls to what the wire does: devices, controls, simulator, verification."""
