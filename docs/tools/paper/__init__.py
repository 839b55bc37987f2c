"""The numbers printed in the Q-NeRF paper (arXiv:2512.12683), beside our runs of the same architectures."""
