"""One self-contained page about a store of runs: `qnerf report runs --out report`."""
