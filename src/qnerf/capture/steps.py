"""What `qnerf capture` asks of COLMAP, through pycolmap, step by step, each in the process that `begin` prepared."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MAX_SIDE = 1600  # pixels; larger images are reduced before features are searched
NEIGHBOURS = 20  # with which an image of a sequence is compared: the next ten, and those 2, 4, 8, ... on
MIN_POINTS = 40  # of a model
MIN_ANGLE = 4.0  # degrees between the rays to a point; a camera that only turns yields 2 to 4 from noise
MAX_STRETCH = 1.1  # of pixels, the longer side over the shorter; noise that yields more than 3 degrees needs 1.3
FLAT = (4, 5, 6)  # COLMAP's numbers for pairs of photographs of a plane, or of a camera that only turned
# For small or few photographs, where COLMAP's own limits leave no pair to begin with.
RELAXED = {"init_min_num_inliers": 30, "init_min_tri_angle": MIN_ANGLE, "abs_pose_min_num_inliers": 15}
PLACED = "placed"  # a file with a byte for each photograph that has been posed so far


@dataclass(frozen=True)
class Model:
    """Photographs that COLMAP has posed together."""

    folder: Path  # of the model, binary
    posed: list[str]  # names
    points: int  # in space, each seen by two photographs or more
    error: float  # mean distance of features from their projected points, pixels
    angle: float  # widest between rays to a point, median over points, degrees
    stretch: float  # of pixels, the longer side over the shorter, the most of all cameras; 1 where they are square


def begin(log: Path) -> None:
    """Ctrl-C ends the process at once, also inside COLMAP; what COLMAP tells goes to a file."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.dup2(os.open(log, os.O_CREAT | os.O_WRONLY), 2)


def extract(database: Path, folder: Path, names: list[str], shared: bool) -> None:
    """Finds the features of the photographs.

    Args:
        database: COLMAP's, to be made.
        folder: of the photographs.
        names: of the photographs.
        shared: all have one camera.
    """
    import pycolmap as sfm

    sfm.extract_features(
        str(database),
        str(folder),
        names,
        camera_mode=sfm.CameraMode.SINGLE if shared else sfm.CameraMode.PER_IMAGE,
        reader_options=sfm.ImageReaderOptions(camera_model="OPENCV" if shared else "SIMPLE_RADIAL"),
        extraction_options=sfm.FeatureExtractionOptions(max_image_size=MAX_SIDE),
    )


def match(database: Path, matching: str) -> None:
    """Compares pairs of photographs, of all ("exhaustive") or of neighbours in the order of names ("sequential")."""
    import pycolmap as sfm

    getattr(sfm, f"match_{matching}")(str(database))


def reconstruct(database: Path, folder: Path, place: Path, min_views: int, relaxed: bool) -> list[Model]:
    """Poses the photographs, and writes models of at least `min_views` of them into `place`; the largest first.

    Models of few points (`MIN_POINTS`), of points seen from nearly one direction (`MIN_ANGLE`), or of cameras that
    nobody builds (`MAX_STRETCH`) are noise and left out.
    """
    import pycolmap as sfm

    pipeline = sfm.IncrementalPipelineOptions(min_model_size=min_views, random_seed=0)
    for key, value in (RELAXED if relaxed else {}).items():
        setattr(pipeline.mapper, key, value)
    with (place / PLACED).open("wb", buffering=0) as counted:

        def one_more() -> None:
            counted.write(b".")

        found = sfm.incremental_mapping(
            str(database), str(folder), str(place), options=pipeline, next_image_callback=one_more
        )
    models = [_written(model, place / f"model{number}") for number, model in found.items()]
    sound = [
        model
        for model in models
        if len(model.posed) >= min_views
        and model.points >= MIN_POINTS
        and model.angle >= MIN_ANGLE
        and model.stretch <= MAX_STRETCH
    ]
    return sorted(sound, key=lambda model: -len(model.posed))


def _written(model: Any, folder: Path) -> Model:
    folder.mkdir()
    model.write(str(folder))
    posed = [image.name for image in model.images.values() if image.has_pose]
    error = float(model.compute_mean_reprojection_error())
    sides = [(camera.focal_length_x, camera.focal_length_y) for camera in model.cameras.values()]
    stretch = max(max(pair) / min(pair) for pair in sides)
    return Model(folder, posed, len(model.points3D), error, _angle(model), stretch)


def _angle(model: Any) -> float:
    centres = {image: model.images[image].projection_center() for image in model.reg_image_ids()}
    widest = []
    for point in model.points3D.values():
        rays = np.stack([centres[seen.image_id] for seen in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        widest.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))
    return float(np.median(widest)) if widest else 0.0


def placed(place: Path) -> int:
    """How many photographs `reconstruct` has posed so far."""
    file = place / PLACED
    return file.stat().st_size if file.exists() else 0


def undistort(model: Path, folder: Path, out: Path, jpeg_quality: int) -> None:
    """Writes the posed photographs without lens distortion, and their model, to `out`/images and `out`/sparse."""
    import pycolmap as sfm

    sfm.undistort_images(str(out), str(model), str(folder), jpeg_quality=jpeg_quality)
