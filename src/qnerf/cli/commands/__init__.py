"""The console commands, one a file.

Each module has `arguments(parser)`, which declares its arguments, and `main(options)`, which runs the command and
returns the exit code, or None for 0. A module is imported only for its own command, so listing runs does not wait for
PyTorch.
"""

import argparse

GROUPS = {
    "train": {
        "run": "train and evaluate one configuration, or a sweep of many",
        "decide": "train only as many seeds as it takes to tell which candidate is better",
        "resume": "continue an interrupted run, or repeat a failed one",
        "reproduce": "train a finished run again and compare every number",
    },
    "bring a scene": {
        "capture": "photographs or a video to a folder with camera poses",
    },
    "look at runs": {
        "runs": "list the runs of a store",
        "show": "everything about one run",
        "diff": "what differs between two runs: configuration, environment, metrics",
    },
    "look at a trained model": {
        "render": "a video along a path of the camera",
        "view": "look around in the browser, also while it trains",
        "export": "points of a model's surfaces",
    },
    "organise runs": {
        "rm": "delete runs",
    },
    "measure a trained model": {
        "probe": "finite shots, noisy gates, dead units, costs",
    },
    "analyse a store of runs": {
        "serve": "a page in the browser that follows the store while runs train",
        "report": "one HTML page to keep: table, plots, curves, pictures",
        "tables": "tables over seeds as Markdown, CSV or LaTeX",
        "figures": "figures as PNG, SVG and PDF",
        "pack": "the runs as a few small tables, to keep beside a paper",
    },
}
"""Title -> command -> purpose, in the order of `qnerf --help`."""

COMMANDS = {name: purpose for commands in GROUPS.values() for name, purpose in commands.items()}

ANALYSIS = {
    "decide": "decide.__main__",
    "serve": "serve.__main__",
    "report": "report.__main__",
    "tables": "tables.__main__",
    "figures": "figures.__main__",
    "pack": "pack",
}
"""Commands of the analysis package -> their module in it; its `main` takes the arguments as strings."""

STORED = "scene.path=DIR: where the scene is now; plugins=[A,B]: modules that the run was trained with; device, threads"
RUN = "a run's folder (runs/ID or ./ID), its id, or a unique part of its id"


def add_store(parser: argparse.ArgumentParser) -> None:
    """`--store`, the folder of runs."""
    parser.add_argument("--store", default="runs", metavar="DIR", help="folder of runs (default: %(default)s)")


def add_run(parser: argparse.ArgumentParser) -> None:
    """One run, as `qnerf.records.find` takes it, and `--store`."""
    parser.add_argument("run", metavar="RUN", help=RUN)
    add_store(parser)


def add_many_runs(parser: argparse.ArgumentParser, more: str = "") -> None:
    """One run or more, and `--store`. more: what else may stand between them."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help=RUN + more)
    add_store(parser)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """What may differ from a stored run. Its folder may come from anybody, so the user has to name its plugins."""
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help=STORED)
