"""What is believed of a wire between exposures, and when X-ray is asked for."""
