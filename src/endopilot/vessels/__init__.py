"""What files hold of a vessel, read into one graph of points and radii: masks, meshes and centerlines."""
