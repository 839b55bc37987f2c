"""Photographs or a video to a scene with camera poses: structure from motion by COLMAP, an extra."""
