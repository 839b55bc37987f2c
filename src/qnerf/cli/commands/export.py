"""`qnerf export RUN...`: points where the training rays end."""

import argparse
from pathlib import Path

from qnerf.cli.commands import STORED, add_many_runs
from qnerf.cli.numbers import MAX_COUNT, number, whole
from qnerf.cli.stored import load_stored, split
from qnerf.records import find
from qnerf.records.printable import printable

_ELSEWHERE = (".obj", ".stl", ".glb", ".gltf", ".fbx")
"""Files of geometry that are not written here; a folder has no such name."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Writes the geometry of trained models as PLY files in the coordinates of transforms.json: points where the "
        "training rays end, with normals and colours."
    )
    add_many_runs(parser, f"; or {STORED}")
    parser.add_argument(
        "--out", metavar="DIR", default="exports", help="a folder (default: exports); of one run also NAME.ply"
    )
    parser.add_argument("--points", type=whole(1, MAX_COUNT), metavar="N", help="training rays (default: 1,000,000)")
    parser.add_argument(
        "--within", type=number(0, 1e6, above=True), metavar="R",
        help="largest coordinate in normalised world units, of which the cameras fill 1 (default: 4)",
    )  # fmt: skip


def main(options: argparse.Namespace) -> None:
    names, overrides = split(options.runs)
    folders = [find(name, options.store) for name in names]
    if not folders:
        raise ValueError("expected a run")

    from qnerf.training.forecast import announced
    from qnerf.viewing import ply, points
    from qnerf.viewing.frames import Renderer

    out = Path(options.out)
    single = out.suffix == ".ply" and not out.is_dir()
    if out.suffix.lower() in _ELSEWHERE:
        raise ValueError(f"--out: expected a folder or NAME.ply, got {printable(out)}; Blender and MeshLab convert PLY")
    if single and len(folders) > 1:
        raise ValueError(f"--out: expected a folder for {len(folders)} runs, got the file {printable(out)}")
    for folder in folders:
        trained = load_stored(folder, overrides)
        renderer = Renderer(trained)
        count = options.points or points.RAYS
        pixels = int(trained.scene.cameras.all_sizes[trained.scene.train].prod(1).sum())
        seconds = renderer.evaluator.seconds(min(count, pixels))
        if line := announced(
            f"{min(count, pixels):,} rays", seconds, trained.settings.run.hours, "--points takes fewer"
        ):
            print(line, flush=True)
        try:
            cloud = points.cloud(points.ray_ends(renderer, count, options.within or points.WITHIN))
        except ValueError as error:
            raise ValueError(f"{folder.name}: {error}") from None
        file = out if single else out / f"{folder.name}.ply"
        ply.write(file, points.world(trained, cloud))
        print(f"{folder.name}: step {trained.step:,}, {len(cloud.points):,} points -> {printable(file)}")
