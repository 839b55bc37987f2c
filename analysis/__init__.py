"""Tables, figures and a report from stored runs.

`load` gives runs and their logged metrics as DataFrames, of which `tables` and `figures` are functions.

    from qnerf.analysis import load

    frame = load.runs("runs")
"""
