"""`qnerf export RUN... --to mlflow|tensorboard|csv`."""

import argparse
import importlib
from pathlib import Path
from types import ModuleType

from qnerf.cli.commands import add_many_runs
from qnerf.cli.errors import report
from qnerf.records import StoreError, find
from qnerf.records.printable import printable

TARGETS = ("mlflow", "tensorboard", "csv")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Copies runs to MLflow, TensorBoard or CSV files; a second export updates the copies."
    add_many_runs(parser)
    parser.add_argument("--to", required=True, choices=TARGETS, help="where the copies go")
    parser.add_argument(
        "--out", metavar="DIR", help="tensorboard, csv: a folder (default: exports/tensorboard, .../csv)"
    )
    parser.add_argument("--uri", help="mlflow: tracking server or database (default: MLflow's own)")
    parser.add_argument("--experiment", metavar="NAME", help="mlflow: experiment to put the runs into (default: qnerf)")


def main(options: argparse.Namespace) -> int:
    target = options.to
    if target == "mlflow" and options.out is not None:
        raise ValueError("--out is for tensorboard and csv; mlflow takes --uri")
    if target != "mlflow" and (options.uri or options.experiment) is not None:
        raise ValueError(f"--uri and --experiment are for mlflow; {target} takes --out")
    folders = [find(name, options.store) for name in options.runs]
    exporter = _exporter(target)
    from qnerf.export.content import read

    code = 0
    for folder in folders:
        try:
            content = read(folder)
            if target == "mlflow":
                copy = exporter.export(content, options.uri, options.experiment or "qnerf")
            else:
                copy = exporter.export(content, Path(options.out or f"exports/{target}"))
        except StoreError as error:  # of this run alone
            code = report(error)
            continue
        print(f"{content.run_id}: {content.state}, step {content.step:,} -> {target} {printable(copy)}")
    if target == "tensorboard":
        print(f"tensorboard --logdir {printable(options.out or 'exports/tensorboard')}")
    return code


def _exporter(target: str) -> ModuleType:
    try:
        return importlib.import_module(f"qnerf.export.to_{target}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "qnerf":
            raise
        raise ValueError(f'{target} is not installed here: pip install "qnerf[{target}]"') from error
