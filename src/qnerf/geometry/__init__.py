"""Rays, rotations, pose refinement, and the space in which density may be."""
