"""Copies of runs for other trackers, one a file: MLflow, TensorBoard, CSV.

Exporting a run twice leaves one copy, up to date. Time stamps are the run's creation plus its seconds of training.
"""
