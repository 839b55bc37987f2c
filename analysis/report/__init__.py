"""One self-contained page about a store of runs: `python -m analysis.report runs --out report`."""
