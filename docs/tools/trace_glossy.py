"""Traces the built-in scene `glossy`: shiny and matte things on a matte table, in a room with three lamps.

    python -m docs.tools.trace_glossy src/qnerf/scenes/glossy.npz

The light that a surface sends to the eye is diffuse, which is the same from everywhere, or specular: Phong lobes of the
lamps, and a mirror image of the room. Metres; z points up; the table is z = 0.
"""

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VIEWS, SIDE, FINE, FOCAL = 120, 64, 6, 1.15  # views; pixels of a side; rays along each axis of a pixel; focal / side
BOUNCES = 3
EPSILON = 1e-4
ROOM = np.array([3.4, 3.4, 2.6])  # half the width and the depth, and the height above the table
FLOOR, TABLE = -0.8, 1.5  # height of the room's floor, radius of the table
LAMPS = np.array([[1.9, -1.3, 2.3], [-2.2, -0.6, 2.1], [0.3, 2.3, 2.4]])
POWER = np.array([[3.8, 2.9, 1.6], [1.1, 1.9, 3.4], [2.6, 1.5, 2.3]])


@dataclass(frozen=True)
class Surface:
    """How a surface answers light.

    lobes: (weight, exponent) of Phong lobes. mirror: share of the mirror image at normal incidence, for each colour; it
    rises to `grazing` where the eye looks along the surface (Schlick 1994).
    """

    color: tuple[float, float, float]
    lobes: tuple[tuple[float, float], ...] = ()
    mirror: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grazing: float = 0.0
    pattern: str = ""


SPHERES = (
    ((0.0, 0.62, 0.42), 0.42, Surface((0.06, 0.06, 0.07), lobes=((1.3, 5), (0.9, 20)))),
    ((-0.66, -0.28, 0.36), 0.36, Surface((0.38, 0.05, 0.05), lobes=((0.9, 8), (1.1, 32), (1.6, 128)))),
    ((0.12, -0.68, 0.22), 0.22, Surface((0, 0, 0), mirror=(0.86, 0.87, 0.88), grazing=0.95)),
    ((-0.72, 0.58, 0.24), 0.24, Surface((0.72, 0.70, 0.60), pattern="stripes")),
)
BOX = (np.array([0.72, -0.12, 0.22]), np.array([0.28, 0.32, 0.26]), 0.5, 0.65)  # centre, half sides, turned, tilted
LACQUER = Surface((0.02, 0.16, 0.20), lobes=((1.5, 6), (1.0, 24)), mirror=(0.08, 0.08, 0.08), grazing=0.5)
WOOD, WALL = Surface((0, 0, 0), pattern="table"), Surface((0, 0, 0), pattern="room")
SURFACES = (*(surface for *_, surface in SPHERES), LACQUER, WOOD, WALL)


def box_frame() -> NDArray:
    (c, s), (up, aside) = ((np.cos(angle), np.sin(angle)) for angle in BOX[2:])
    return np.array([[1, 0, 0], [0, up, aside], [0, -aside, up]]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def slabs(origin: NDArray, ray: NDArray, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:
    """Distances (N, 3) where rays enter and leave the three pairs of planes of a box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (low - origin) / ray, (high - origin) / ray
    return np.minimum(one, other), np.maximum(one, other)


def hit(origin: NDArray, ray: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """The first surface that each ray (N, 3) meets: distance (N,), number in `SURFACES` (N,), normal (N, 3)."""
    low, high = np.array([-ROOM[0], -ROOM[1], FLOOR]), ROOM
    leave = slabs(origin, ray, low, high)[1]
    axis = leave.argmin(1)
    distance, number = leave.min(1), np.full(len(ray), len(SURFACES) - 1)
    normal = -np.sign(ray) * np.eye(3)[axis]

    def nearer(found: NDArray, which: int, normals: NDArray) -> None:
        closer = (found > EPSILON) & (found < distance)
        distance[closer], number[closer], normal[closer] = found[closer], which, normals[closer]

    for index, (centre, radius, _) in enumerate(SPHERES):
        off = origin - np.array(centre)
        half, rest = (off * ray).sum(1), (off**2).sum(1) - radius**2
        root = half**2 - rest
        found = np.where(root > 0, -half - np.sqrt(np.maximum(root, 0)), np.inf)
        nearer(found, index, (off + np.where(np.isfinite(found), found, 0)[:, None] * ray) / radius)
    centre, half_sides, *_ = BOX
    frame = box_frame()
    enter, leave = slabs((origin - centre) @ frame.T, ray @ frame.T, -half_sides, half_sides)
    found = np.where(enter.max(1) < leave.min(1), enter.max(1), np.inf)
    nearer(found, len(SPHERES), (-np.sign(ray @ frame.T) * np.eye(3)[enter.argmax(1)]) @ frame)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = -origin[:, 2] / ray[:, 2]
        point = origin[:, :2] + np.where(np.isfinite(found), found, 0)[:, None] * ray[:, :2]
    found = np.where((point**2).sum(1) < TABLE**2, found, np.inf)
    nearer(found, len(SPHERES) + 1, np.broadcast_to([0.0, 0.0, 1.0], ray.shape))
    return distance, number, normal


def table(point: NDArray) -> NDArray:
    """The table's own colour (N, 3): squares of 30 cm in two woods, with a few wide waves."""
    x, y = point[:, 0], point[:, 1]
    dark = (np.floor(x / 0.3) + np.floor(y / 0.3)) % 2
    wave = 0.85 + 0.15 * np.sin(9 * x + 3 * np.sin(4 * y))
    return np.where(dark[:, None] > 0, [0.34, 0.20, 0.10], [0.66, 0.52, 0.34]) * wave[:, None]


def room(point: NDArray) -> NDArray:
    """The light (N, 3) that the room's walls, floor and ceiling send out, the same in all directions."""
    x, y, z = point.T
    light = np.broadcast_to([0.16, 0.15, 0.15], point.shape).copy()
    floor, ceiling = z < FLOOR + 1e-3, z > ROOM[2] - 1e-3
    light[floor] = np.where(((np.floor(x) + np.floor(y)) % 2 > 0)[floor, None], [0.10, 0.08, 0.08], [0.22, 0.20, 0.18])
    light[ceiling] = [0.42, 0.42, 0.40]
    light[ceiling & (np.abs(x) < 0.5) & (np.abs(y - 0.6) < 1.6)] = [1.0, 0.96, 0.86]
    upright = ~floor & ~ceiling
    for wall, color in (
        (x > ROOM[0] - 1e-3, [0.55, 0.17, 0.10]),
        (x < 1e-3 - ROOM[0], [0.10, 0.22, 0.50]),
        (y > ROOM[1] - 1e-3, [0.14, 0.38, 0.16]),
        (y < 1e-3 - ROOM[1], [0.62, 0.50, 0.18]),
    ):
        along = np.where(np.abs(x) > ROOM[0] - 1e-3, y, x)
        band = (np.floor((along + 10) / 0.85) % 2 > 0)[:, None]
        light = np.where((wall & upright)[:, None], np.where(band, color, np.array(color) * 0.45), light)
        window = wall & upright & (np.abs(along + 0.9) < 0.6) & (z > 0.5) & (z < 1.9)
        light[window] = [0.80, 0.92, 1.0]
    return light


def radiance(origin: NDArray, ray: NDArray, bounces: int = BOUNCES) -> tuple[NDArray, NDArray]:
    """Diffuse and specular light (N, 3) that reaches the eye along each ray."""
    distance, number, normal = hit(origin, ray)
    point = origin + distance[:, None] * ray
    color = np.array([surface.color for surface in SURFACES])[number]
    color[number == len(SPHERES) + 1] = table(point[number == len(SPHERES) + 1])
    striped = number == len(SPHERES) - 1
    bands = np.sin(26 * point[striped, 2]) * np.sin(4 * np.arctan2(normal[striped, 1], normal[striped, 0]))
    color[striped] = np.where(bands[:, None] > 0, color[striped], [0.10, 0.16, 0.42])
    mirrored = ray - 2 * (ray * normal).sum(1)[:, None] * normal
    diffuse = color * (0.26 + 0.10 * normal[:, 2:])  # of the walls and the ceiling
    specular = np.zeros_like(diffuse)
    wall = number == len(SURFACES) - 1
    start = point + EPSILON * normal
    for lamp, power in zip(LAMPS, POWER, strict=True):
        to = lamp - start
        far = np.sqrt((to**2).sum(1))
        to /= far[:, None]
        facing = (to * normal).sum(1)
        lit = ~wall & (facing > 0)
        lit[lit] = hit(start[lit], to[lit])[0] > far[lit] - 1e-2
        arrives = np.where(lit, 1 / far**2, 0)[:, None] * power
        diffuse += color * arrives * facing[:, None].clip(0)
        near = (to * mirrored).sum(1).clip(0)
        for index, surface in enumerate(SURFACES):
            of = number == index
            for weight, exponent in surface.lobes:
                specular[of] += weight * arrives[of] * near[of, None] ** exponent
    diffuse[wall] = room(point[wall])
    share = np.array([surface.mirror for surface in SURFACES])[number]
    rise = (1 - (-(ray * normal).sum(1)).clip(0, 1)) ** 5
    grazing = np.array([surface.grazing for surface in SURFACES])[number]
    share = share + (grazing[:, None] - share).clip(0) * rise[:, None]
    shiny = grazing > 0
    if bounces and shiny.any():
        specular[shiny] += share[shiny] * sum(radiance(start[shiny], mirrored[shiny], bounces - 1))
    return diffuse, specular


def poses() -> NDArray:
    """Camera-to-world poses (V, 3, 4) on a dome around the table, 14 to 60 degrees high, turned by golden angles."""
    share = (np.arange(VIEWS) + 0.5) / VIEWS
    height = np.arcsin(np.sin(np.radians(14)) + share * (np.sin(np.radians(60)) - np.sin(np.radians(14))))
    turn = np.arange(VIEWS) * np.pi * (3 - np.sqrt(5))
    outward = np.stack([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)], 1)
    right = np.cross([0.0, 0.0, 1.0], outward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    centre = np.array([0.0, 0.0, 0.2]) + 2.7 * outward
    return np.stack([right, np.cross(outward, right), outward, centre], 2)


def rays(pose: NDArray, fine: int) -> NDArray:
    """Unit vectors through the centres of fine x fine parts of each pixel, (S * fine * S * fine, 3), row by row."""
    place = ((np.arange(SIDE * fine) + 0.5) / fine - SIDE / 2) / (FOCAL * SIDE)
    v, u = (part.ravel() for part in np.meshgrid(place, place, indexing="ij"))
    ray = u[:, None] * pose[:, 0] - v[:, None] * pose[:, 1] - pose[:, 2]
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def encoded(light: NDArray) -> NDArray:
    """Linear light in [0, 1] -> sRGB in levels 0 to 255."""
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clip(1e-9) ** (1 / 2.4) - 0.055)


def traced(pose: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Image (S, S, 3) uint8, specular levels (S, S) uint8, depth (S, S) float16 of one view."""

    def pixels(light: NDArray) -> NDArray:
        return encoded(light.clip(0, 1).reshape(SIDE, FINE, SIDE, FINE, 3).mean((1, 3)))

    fine = rays(pose, FINE)
    diffuse, specular = radiance(np.broadcast_to(pose[:, 3], fine.shape), fine)
    whole, matte = pixels(diffuse + specular), pixels(diffuse)
    centres = rays(pose, 1)
    depth = hit(np.broadcast_to(pose[:, 3], centres.shape), centres)[0].reshape(SIDE, SIDE)
    return whole.round().astype(np.uint8), (whole - matte).max(-1).round().astype(np.uint8), depth.astype(np.float16)


if __name__ == "__main__":
    path = poses()
    images, specular, depth = (np.stack(part) for part in zip(*map(traced, path), strict=True))
    np.savez_compressed(sys.argv[1], images=images, specular=specular, depth=depth, poses=path)
