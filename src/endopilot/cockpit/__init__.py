"""The cockpit: a web page on this machine in which a wire is watched, driven by hand, or left to a policy."""
