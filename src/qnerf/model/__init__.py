"""The trained modules: the field, and the whole model."""
