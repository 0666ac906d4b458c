"""From a vessel mask, surface or centerline to an `Anatomy` that a wire can be simulated in."""
