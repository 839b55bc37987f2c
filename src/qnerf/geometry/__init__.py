"""Cameras, rays and space."""
