"""The robot that drives the devices: limits, simulated drive, remote drive."""
