"""The console commands, one a file.

Each module has `arguments(parser)`, which says what it takes, and `main(options)`, which does it and returns the exit
code or None for 0. Modules are imported when their command is asked for, so that listing runs never waits for PyTorch.
"""

import argparse

COMMANDS = {
    "runs": "list the runs of a store",
    "show": "everything about one run",
    "diff": "what differs between two runs: configuration, environment, metrics",
    "watch": "a run, or the whole store, refreshing while it trains",
    "tag": "add or remove a run's tags",
    "note": "read or write a run's note",
    "rm": "delete runs",
    "resume": "go on with an interrupted run, or do a failed one again",
    "reproduce": "run a finished run again and compare every number",
    "export": "copy a run to MLflow, TensorBoard or CSV",
    "replay": "repeat the step in which numerics.finite_checks=true found a value that is not finite",
    "evaluate": "measure a finished run further: finite shots, noisy gates, spectra, encodings, samples",
}
"""Name -> what it does, in the order of the help. `run` is not here: Hydra reads its arguments."""


def add_store(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--store", default="runs", metavar="DIR", help="folder of runs (default: runs)")


def add_run(parser: argparse.ArgumentParser) -> None:
    """One run, as `qnerf.records.find` takes it."""
    parser.add_argument("run", metavar="RUN", help="a run's folder, its id, or a part of its id that no other has")
    add_store(parser)


def add_plugins(parser: argparse.ArgumentParser) -> None:
    """The modules that a run with plugins needs: its folder may come from anybody, so the user has to name them."""
    parser.add_argument("plugins", nargs="*", metavar="plugins=[A,B]", help="modules that the run was trained with")
