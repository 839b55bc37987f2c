"""`qnerf export RUN... --to mlflow|tensorboard|csv|points|mesh`."""

import argparse
import importlib
from pathlib import Path
from types import ModuleType

from qnerf.cli.commands import add_many_runs
from qnerf.cli.errors import report
from qnerf.cli.numbers import MAX_COUNT, number, whole
from qnerf.records import StoreError, find
from qnerf.records.printable import printable

TARGETS = ("mlflow", "tensorboard", "csv", "points", "mesh")
GEOMETRY = ("points", "mesh")
OF_GEOMETRY = {"points": GEOMETRY, "within": GEOMETRY, "cells": ("mesh",), "level": ("mesh",)}
"""Option -> the targets that take it."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Copies runs to MLflow, TensorBoard or CSV files; a second export updates the copies. Or writes the "
        "geometry of their models as PLY files in the coordinates of transforms.json: points where the training rays "
        "end, or a mesh."
    )
    add_many_runs(parser)
    parser.add_argument("--to", required=True, choices=TARGETS, help="where the copies go")
    parser.add_argument(
        "--out", metavar="DIR",
        help="a folder, but for mlflow (default: exports/csv, ...); for points or a mesh of one run also NAME.ply",
    )  # fmt: skip
    parser.add_argument("--uri", help="mlflow: tracking server or database (default: MLflow's own)")
    parser.add_argument("--experiment", metavar="NAME", help="mlflow: experiment to put the runs into (default: qnerf)")
    parser.add_argument(
        "--points", type=whole(1, MAX_COUNT), metavar="N", help="points, mesh: training rays (default: 1,000,000)"
    )
    parser.add_argument(
        "--within", type=number(0, 1e6, above=True), metavar="R",
        help="points, mesh: largest coordinate in normalised world units, of which the cameras fill 1 (default: 4)",
    )  # fmt: skip
    parser.add_argument(
        "--cells", type=whole(2, 4096), metavar="N", help="mesh: of the grid's longest side (default: 192)"
    )
    parser.add_argument(
        "--level", type=number(0, 1e9, above=True), metavar="DENSITY",
        help="mesh: density of its surface (default: half of the light is absorbed within 5 %% of the longest side)",
    )  # fmt: skip


def main(options: argparse.Namespace) -> int:
    target = options.to
    if target == "mlflow" and options.out is not None:
        raise ValueError("mlflow takes --uri, not --out")
    if target != "mlflow" and (options.uri or options.experiment) is not None:
        raise ValueError(f"--uri and --experiment are for mlflow; {target} takes --out")
    for name, targets in OF_GEOMETRY.items():
        if getattr(options, name) is not None and target not in targets:
            raise ValueError(f"--{name} is for {' and '.join(targets)}")
    folders = [find(name, options.store) for name in options.runs if not name.startswith("plugins=")]
    if target in GEOMETRY:
        return _geometry(folders, options)
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


def _geometry(folders: list[Path], options: argparse.Namespace) -> int:
    """Writes `<out>/<run id>.ply` of each run, or the file `out` of a single one."""
    from qnerf.cli.upgrade_config import load_stored
    from qnerf.viewing import ply, surfaces
    from qnerf.viewing.frames import Renderer

    out = Path(options.out or f"exports/{options.to}")
    single = out.suffix == ".ply" and not out.is_dir()
    if single and len(folders) > 1:
        raise ValueError(f"--out: expected a folder for {len(folders)} runs, got the file {printable(out)}")
    for folder in folders:
        trained = load_stored(folder, [name for name in options.runs if name.startswith("plugins=")])
        renderer = Renderer(trained)
        hits = surfaces.ray_ends(renderer, options.points or surfaces.RAYS, options.within or surfaces.WITHIN)
        if options.to == "points":
            surface = surfaces.cloud(hits)
        else:
            surface = surfaces.mesh(renderer, hits, options.cells or surfaces.CELLS, options.level)
        file = out if single else out / f"{folder.name}.ply"
        ply.write(file, surfaces.world(trained, surface))
        triangles = "" if surface.faces is None else f", {len(surface.faces):,} triangles"
        print(f"{folder.name}: step {trained.step:,}, {len(surface.points):,} points{triangles} -> {printable(file)}")
    return 0


def _exporter(target: str) -> ModuleType:
    try:
        return importlib.import_module(f"qnerf.export.to_{target}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "qnerf":
            raise
        raise ValueError(f'{target} is not installed here: pip install "qnerf[{target}]"') from error
