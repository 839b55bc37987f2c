"""The built-in scene, whose images lie in the package."""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval

from qnerf.scenes.base import MIN_VIEWS, SCENES, Cameras, Scene, digest, split_views
from qnerf.scenes.normalise import normalise

FILE = Path(__file__).with_suffix(".npz")
"""images (V, H, W, 3) uint8, depth (V, H, W) float32 in metres, and camera-to-world poses (V, 3, 4) float64 in metres.

The package traced them itself until commit a5c66ca, with `render_views` of src/qnerf/scenes/builtin/poster.py.
"""
VIEWS, WIDTH, HEIGHT = 226, 36, 64
TRACED = ("1", 4, 0)  # version of the images, rays along each axis of a pixel, seed of the camera's path
FOCAL = 0.72  # focal length / longer side of the image


@SCENES.register("poster")
def poster(*, path: str | None = None, views: Annotated[int, Interval(ge=MIN_VIEWS, le=VIEWS)] = VIEWS) -> Scene:
    """A corner of a room with a framed poster, seen by a hand-held camera, with exact depth: 36 x 64 pixels.

    Args:
        path: must be None: the scene is built in.
        views: number of images, evenly spread over the camera's path.

    Raises:
        ValueError: an option is out of range, or `path` is not None.
    """
    if path is not None:
        raise ValueError(f"scene=poster is built in and has no path, got {path!r}; for images use scene=nerfstudio")
    chosen = np.linspace(0, VIEWS - 1, views).round().astype(int)
    with np.load(FILE, allow_pickle=False) as stored:
        images, depth, poses = (stored[name][chosen] for name in ("images", "depth", "poses"))
    poses, transform = normalise(poses)
    depth *= np.float32(np.cbrt(np.linalg.det(transform[:3, :3])))  # metres -> normalised world units
    focal = FOCAL * max(WIDTH, HEIGHT)
    lens = np.tile([focal, focal, WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0], (views, 1))
    train, held_out = split_views(views)
    version, *rays_and_seed = TRACED
    return Scene(
        name="poster",
        images=torch.from_numpy(images),
        cameras=Cameras.from_arrays(poses, lens, np.array([WIDTH, HEIGHT])),
        train=train,
        eval=held_out,
        names=[f"{view:0{len(str(views - 1))}d}" for view in range(views)],
        fingerprint=digest("poster", version, np.array([views, WIDTH, HEIGHT, *rays_and_seed])),
        transform=torch.from_numpy(transform),
        depth=torch.from_numpy(depth),
    )
