"""Scenes made to need something, or not to: their images follow from their cameras."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from qnerf.geometry import camera_paths
from qnerf.geometry.rays import camera_rays
from qnerf.scenes import Cameras, Scene

BALL = 0.4  # radius in world units
INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}


def look_at(centre, target) -> np.ndarray:
    """The pose (3, 4) of a camera at `centre` that looks at `target`, +z up."""
    return camera_paths.look_at(np.array(centre, dtype=float), np.array(target, dtype=float), np.array([0, 0, 1.0]))


def ring(views: int, radius: float = 1.0, height: float = 0.5, outward: bool = False) -> np.ndarray:
    """Poses (V, 3, 4) on a circle around the z axis that look at the origin, or away from it."""
    angles = 2 * np.pi * np.arange(views) / views
    centres = [(radius * np.cos(angle), radius * np.sin(angle), height) for angle in angles]
    return np.stack([look_at(centre, 2 * np.array(centre) if outward else np.zeros(3)) for centre in centres])


def cameras(poses: np.ndarray, width: int = 32, height: int = 24, focal: float = 30.0) -> Cameras:
    views = len(poses)
    same = torch.ones(views, dtype=torch.float64)
    middle = width / 2 * same, height / 2 * same
    lens = torch.zeros(views, 4, dtype=torch.float64)
    return Cameras(torch.from_numpy(poses), focal * same, focal * same, *middle, lens, width, height)


def scene(images: torch.Tensor, of: Cameras, **options) -> Scene:
    """All views but the last train."""
    views = len(of)
    given = {
        "train": list(range(views - 1)),
        "eval": [views - 1],
        "names": [f"{view:03d}.png" for view in range(views)],
    }
    given |= {"fingerprint": "", "transform": torch.eye(4, dtype=torch.float64)}
    return Scene("world", images, of, **{**given, **options})


def pixel_rays(of: Cameras, view: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and unit directions (H, W, 3) through the pixels' centres."""
    y, x = torch.meshgrid(torch.arange(of.height), torch.arange(of.width), indexing="ij")
    centres = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    rays = camera_rays(of, torch.full((len(centres),), view), centres, 0.0, 1.0, torch.float64)
    return rays.origins.view(of.height, of.width, 3), rays.directions.view(of.height, of.width, 3)


def balls(of: Cameras, *spheres: tuple[tuple[float, float, float], float]) -> torch.Tensor:
    """Images (V, H, W, 4): alpha is 255 where the ray through a pixel's centre meets a sphere (centre, radius)."""
    images = torch.full((len(of), of.height, of.width, 4), 128, dtype=torch.uint8)
    images[..., 3] = 0
    for view in range(len(of)):
        origins, directions = pixel_rays(of, view)
        for centre, radius in spheres:
            offset = torch.tensor(centre, dtype=torch.float64) - origins
            along = (offset * directions).sum(-1)
            nearest = torch.linalg.vector_norm(offset - along[..., None] * directions, dim=-1)
            images[view, ..., 3][(nearest <= radius) & (along > 0)] = 255
    return images


def ball(views: int = 12, size: int = 64, focal: float = 58.0, radius: float = BALL) -> Scene:
    """A ball at the origin, in the middle of all images and well inside them."""
    of = cameras(ring(views), size, size, focal)
    return scene(balls(of, ((0, 0, 0), radius)), of)


def contradicting() -> Scene:
    """Silhouettes of a ball that is above the origin in every second view, and below it in the others."""
    of = cameras(ring(8), 64, 64, 58.0)
    images = [balls(of, ((0, 0, 0.35 * (-1) ** view), 0.05))[view] for view in range(8)]
    return scene(torch.stack(images), of)


def bent() -> Scene:
    """A ball, seen through lenses that distort."""
    world = ball()
    lens = torch.full_like(world.cameras.distortion, 0.01)
    return dataclasses.replace(world, cameras=dataclasses.replace(world.cameras, distortion=lens))


def texture(x: np.ndarray, y: np.ndarray, detail: float) -> np.ndarray:
    """A grey pattern in [0.2, 0.8]; `detail` is its finest frequency in cycles a world unit."""
    random = np.random.default_rng(0)
    total = np.zeros_like(x)
    for frequency in detail * np.linspace(0.15, 1, 24):
        angle, phase = random.uniform(0, 2 * np.pi, 2)
        total += np.cos(2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    return 0.5 + 0.3 * np.tanh(total / np.sqrt(12))


def floor(views: int = 12, detail: float = 8.0, width: int = 48, height: int = 48, focal: float = 40.0) -> Scene:
    """Cameras in a row, 1 above a patterned floor, that look down at it: the views overlap their neighbours."""
    across = np.linspace(-0.6, 0.6, views)
    of = cameras(np.stack([look_at((x, 0.05, 1.0), np.array([x, 0.0, 0.0])) for x in across]), width, height, focal)
    images = torch.empty(views, height, width, 3, dtype=torch.uint8)
    for view in range(views):
        origins, directions = pixel_rays(of, view)
        hit = (origins - directions * (origins[..., 2:] / directions[..., 2:])).numpy()
        grey = texture(hit[..., 0], hit[..., 1], detail)
        images[view] = torch.from_numpy((255 * grey).round()).to(torch.uint8)[..., None]
    return scene(images, of)


def constant(value: int, views: int = 6, channels: int = 3, **options) -> Scene:
    of = cameras(ring(views), **options)
    return scene(torch.full((views, of.height, of.width, channels), value, dtype=torch.uint8), of)


def brightened(of: Scene, spread: float, seed: int = 0) -> Scene:
    """Each view's values times a factor of its own, whose logarithm has this standard deviation."""
    drawn = np.random.default_rng(seed).normal(size=(len(of.images), 1, 1, 1))
    factors = torch.from_numpy(np.exp(spread * drawn / drawn.std()))
    return dataclasses.replace(of, images=(of.images * factors).round().clamp(0, 255).to(torch.uint8))


def turned(of: Scene, degrees: float, seed: int = 0) -> Scene:
    """Poses turned by random angles of this root mean square, each about the camera's own centre."""
    vectors = np.random.default_rng(seed).normal(size=(len(of.images), 3)) * np.deg2rad(degrees) / np.sqrt(3)
    poses = of.cameras.poses.clone()
    poses[:, :, :3] = poses[:, :, :3] @ torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    return dataclasses.replace(of, cameras=dataclasses.replace(of.cameras, poses=poses))


def write(of: Scene, folder: Path) -> Path:
    """The scene as a nerfstudio folder, which orients, centres and scales it anew."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for name, image, pose in zip(of.names, of.images, of.cameras.poses, strict=True):
        Image.fromarray(image.numpy()).save(folder / "images" / name)
        matrix = [*pose.tolist(), [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix})
    transforms = {"w": of.cameras.width, "h": of.cameras.height, "frames": frames}
    transforms |= {name: float(getattr(of.cameras, key)[0]) for name, key in INTRINSICS.items()}
    (folder / "transforms.json").write_text(json.dumps(transforms))
    return folder
