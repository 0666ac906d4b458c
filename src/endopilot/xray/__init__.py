"""X-ray: the C-arm, calibrated bands around a model's predictions, and the adviser that requests an exposure."""
