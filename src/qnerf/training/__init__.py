"""The training loop, its losses, and the evaluation of held-out views."""
