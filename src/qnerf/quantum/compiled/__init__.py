"""The compiled CPU engines."""
