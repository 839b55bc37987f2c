"""Tables, figures and a report from stored runs.

- `load`: runs and their logged metrics as DataFrames
- `tables`: means over seeds, differences with their uncertainty, what a scene needs
- `figures`: matplotlib figures, each with the function that computes what it draws
- `hsv`: distributions of hue, saturation and value, and tests between them
- `paper`: the numbers of the Q-NeRF paper beside ours
- `report`: one HTML page about a folder of runs
- `pack`: a folder of runs as small tables, which everything here reads like the runs themselves

    from qnerf.analysis import load

    frame = load.runs("runs")
"""
