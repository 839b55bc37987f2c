"""The loop, its losses, and how good held-out views are."""
