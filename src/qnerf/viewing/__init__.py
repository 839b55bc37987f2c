"""A trained model, looked at: pictures and videos from any camera, point clouds, the viewer."""
