"""The synthetic CT angiogram of an anatomy."""
