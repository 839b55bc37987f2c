"""The trained modules: the field, its occupancy grid, and the whole model."""
