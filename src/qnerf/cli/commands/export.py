"""`qnerf export RUN... --to mlflow|tensorboard|csv|points|mesh`."""

import argparse
import importlib
from pathlib import Path

from qnerf.cli.commands import STORED, add_many_runs
from qnerf.cli.errors import report
from qnerf.cli.numbers import MAX_COUNT, number, whole
from qnerf.cli.stored import load_stored, split
from qnerf.records import StoreError, find
from qnerf.records.printable import printable

COPIES, GEOMETRY = ("mlflow", "tensorboard", "csv"), ("points", "mesh")
TARGETS_OF = {
    "uri": ("mlflow",),
    "experiment": ("mlflow",),
    "out": ("tensorboard", "csv", *GEOMETRY),
    "points": GEOMETRY,
    "within": GEOMETRY,
    "cells": ("mesh",),
    "level": ("mesh",),
}
"""Option -> the targets that take it."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Copies runs to MLflow, TensorBoard or CSV files; a second export updates the copies. Or writes the "
        "geometry of their models as PLY files in the coordinates of transforms.json: points where the training rays "
        "end, or a mesh."
    )
    add_many_runs(parser, f"; points, mesh: also {STORED}")
    parser.add_argument("--to", required=True, choices=(*COPIES, *GEOMETRY), help="where the copies go")
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
    for name, targets in TARGETS_OF.items():
        if getattr(options, name) is not None and options.to not in targets:
            raise ValueError(f"--{name} is for {' and '.join(targets)}")
    names, overrides = split(options.runs)
    folders = [find(name, options.store) for name in names]
    if not folders:
        raise ValueError("expected a run")
    if options.to in GEOMETRY:
        return _geometry(folders, overrides, options)
    return _copies(folders, options)


def _copies(folders: list[Path], options: argparse.Namespace) -> int:
    try:
        exporter = importlib.import_module(f"qnerf.export.to_{options.to}")
    except ModuleNotFoundError as error:
        raise ValueError(f'{options.to} is not installed here: pip install "qnerf[{options.to}]"') from error
    from qnerf.export.content import read

    code, out = 0, Path(options.out or f"exports/{options.to}")
    for folder in folders:
        try:
            content = read(folder)
            place = (options.uri, options.experiment or "qnerf") if options.to == "mlflow" else (out,)
            copy = exporter.export(content, *place)
        except StoreError as error:  # of this run alone
            code = report(error)
            continue
        print(f"{printable(folder.name)}: {content.run.state}, step {content.step:,} -> {options.to} {printable(copy)}")
    if options.to == "tensorboard":
        print(f"tensorboard --logdir {printable(out)}")
    return code


def _geometry(folders: list[Path], overrides: list[str], options: argparse.Namespace) -> int:
    """Writes `<out>/<run id>.ply` of each run, or the file `out` of a single one."""
    from qnerf.viewing import ply, surfaces
    from qnerf.viewing.frames import Renderer

    out = Path(options.out or f"exports/{options.to}")
    single = out.suffix == ".ply" and not out.is_dir()
    if single and len(folders) > 1:
        raise ValueError(f"--out: expected a folder for {len(folders)} runs, got the file {printable(out)}")
    for folder in folders:
        trained = load_stored(folder, overrides)
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
