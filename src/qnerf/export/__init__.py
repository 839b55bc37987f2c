"""Copies of runs for other trackers, one a file: MLflow, TensorBoard, CSV.

Exporting a run again updates its copy and doubles nothing. A time stamp is the run's creation plus the seconds of
training.
"""
