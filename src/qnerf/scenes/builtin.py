"""The built-in scenes, whose images lie in the package.

NAME.npz has images (V, H, W, 3) uint8, depth (V, H, W) in metres and camera-to-world poses (V, 3, 4) float64 in metres.
`glossy` has `Scene.specular`, too.

The package traced `poster` itself until commit a5c66ca, with `render_views` of src/qnerf/scenes/builtin/poster.py.
`python -m docs.tools.trace_glossy src/qnerf/scenes/glossy.npz` traced `glossy`; commit 8ebc758a has the script.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval

from qnerf.scenes.base import MIN_VIEWS, SCENES, Cameras, Scene, digest, split_views
from qnerf.scenes.normalise import normalise

POSTER_VIEWS, GLOSSY_VIEWS = 226, 120


@SCENES.register("poster")
def poster(
    *, path: str | None = None, views: Annotated[int, Interval(ge=MIN_VIEWS, le=POSTER_VIEWS)] = POSTER_VIEWS
) -> Scene:
    """A corner of a room with a framed poster, seen by a hand-held camera, with exact depth: 36 x 64 pixels.

    Args:
        path: must be None: the scene is built in.
        views: number of images, evenly spread over the camera's path.

    Raises:
        ValueError: an option is out of range, or `path` is not None.
    """
    return _stored("poster", path, POSTER_VIEWS, views, focal=0.72, traced=("1", 4, 0))  # seed 0 of the camera's path


@SCENES.register("glossy")
def glossy(
    *, path: str | None = None, views: Annotated[int, Interval(ge=MIN_VIEWS, le=GLOSSY_VIEWS)] = GLOSSY_VIEWS
) -> Scene:
    """Things on a matte table, in a room with three lamps: 64 x 64 pixels from all around, with depth to 0.05 %.

    A mirror, a ball of dull metal, a red one with highlights and a tilted, glossy box change with the view. A striped
    ball, the table and the room do not. `Scene.specular` tells their light apart.

    Args:
        path: must be None: the scene is built in.
        views: number of images, evenly spread from the lowest to the highest.

    Raises:
        ValueError: an option is out of range, or `path` is not None.
    """
    return _stored("glossy", path, GLOSSY_VIEWS, views, focal=1.15, traced=("1", 6))


def _stored(
    name: str, path: str | None, stored: int, views: int, focal: float, traced: tuple[str, *tuple[int, ...]]
) -> Scene:
    """Some of the stored views.

    focal: focal length / longer side of the image. traced: version of the images, rays along each axis of a pixel, and
    what else made them.
    """
    if path is not None:
        raise ValueError(f"scene={name} is built in and has no path, got {path!r}; for images use scene=nerfstudio")
    chosen = np.linspace(0, stored - 1, views).round().astype(int)
    with np.load(Path(__file__).with_name(f"{name}.npz"), allow_pickle=False) as arrays:
        parts = {part: arrays[part][chosen] for part in arrays}
    poses, transform = normalise(parts["poses"])
    scale = np.float32(np.cbrt(np.linalg.det(transform[:3, :3])))  # metres -> normalised world units
    height, width = parts["images"].shape[1:3]
    pixels = focal * max(width, height)
    lens = np.tile([pixels, pixels, width / 2, height / 2, 0, 0, 0, 0], (views, 1))
    train, held_out = split_views(views)
    version, *others = traced
    return Scene(
        name=name,
        images=torch.from_numpy(parts["images"]),
        cameras=Cameras.from_arrays(poses, lens, np.array([width, height])),
        train=train,
        eval=held_out,
        names=[f"{view:0{len(str(views - 1))}d}" for view in range(views)],
        fingerprint=digest(name, version, np.array([views, width, height, *others])),
        transform=torch.from_numpy(transform),
        depth=torch.from_numpy(parts["depth"].astype(np.float32) * scale),
        specular=torch.from_numpy(parts["specular"]) if "specular" in parts else None,
    )
