"""The built-in room: a corner with a framed poster, brick, wallpaper, a wooden floor, furniture and a mirror ball.

Lengths are metres. The poster's wall is y = 0: x runs along it, y into the room, z up.
"""

from functools import cache
from math import radians

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.builtin import textures as paint
from qnerf.scenes.builtin.atlas import Atlas
from qnerf.scenes.builtin.light import Panel, bake
from qnerf.scenes.builtin.tracer import Ball, Box, World

ROOM = (3.9, 4.0, 2.6)
POSTER = (1.05, 1.4)  # width, height
LAMP, WINDOW = 15.0, 12.5  # radiance


@cache
def room() -> World:
    """The room with its baked light; always the same."""
    atlas = Atlas()

    x, y, z = ROOM
    floor = paint.planks(1024, 1024, (x, y), "6b4a2f", "b58a5c", 1, 0.14)
    floor = paint.rug(floor, (x, y), (1.45, y - 1.4), (1.05, 0.62))
    faces_of_room = [
        atlas.add(paint.shelves(256, 256, (y, z))),
        atlas.add(paint.bricks(1024, 1024, (y, z))),
        atlas.add(paint.paint("d9cdb8", 256, 256, (x, z), 2)),
        atlas.add(paint.wallpaper(1024, 1024, (x, z))),
        atlas.add(paint.paint("f2efe8", 128, 128, (x, y), 3)),
        atlas.add(floor),
    ]
    white, dark, walnut = (
        atlas.add(paint.plain("f4f1ea")),
        atlas.add(paint.plain("2a1d14")),
        atlas.add(paint.plain("5a3b27")),
    )
    astronaut, cat, cup = (paint.photograph(name) for name in ("astronaut", "chelsea", "coffee"))
    poster = atlas.add(paint.framed(astronaut[:, 64:448], 1024, 768, POSTER, "4a2f1e", 0.05))
    small = atlas.add(paint.framed(cat, 512, 768, (0.75, 0.55), "1f1f22", 0.03))
    sideboard = (1.4, 0.4, 0.56)
    top = atlas.add(paint.planks(256, 512, sideboard[:2], "5a3a26", "9a6d48", 4, 0.1))
    front = atlas.add(paint.drawers(256, 512, (sideboard[0], sideboard[2]), 3, 2))
    side = atlas.add(paint.planks(256, 256, (sideboard[1], sideboard[2]), "4a2f20", "8a5f3f", 5, 0.14))
    checks = [
        atlas.add(paint.checker(256, 256, 4, a, b))
        for a, b in (("e8e3d5", "1f4e5f"), ("e8e3d5", "b23a48"), ("f0c987", "2f2f3a"))
    ]
    rings = atlas.add(paint.stripes(512, 64, 14, ("e94f37", "f6f7eb", "3f88c5", "f6f7eb", "44bba4", "393e41"), 0.7))
    magazine = atlas.add(paint.resized(cup, 512, 512))
    spines = [
        atlas.add(paint.stripes(32, 256, 1, (color, color), 0)) for color in ("a63d40", "e9b872", "90a959", "6494aa")
    ]
    swirl = atlas.add(paint.stripes(128, 256, 5, ("c1121f", "c1121f", "fdf0d5"), 4))
    silver = atlas.add(paint.plain("c8ccd0"))
    panes = atlas.add(paint.panes(256, 256, 2, 3))

    def block(
        middle: tuple[float, float], base: float, size: tuple[float, float, float], yaw: float, faces: list[int]
    ) -> Box:
        low = (middle[0] - size[0] / 2, middle[1] - size[1] / 2, base)
        high = (middle[0] + size[0] / 2, middle[1] + size[1] / 2, base + size[2])
        return Box(low, high, faces, radians(yaw))

    def book(middle: tuple[float, float], base: float, yaw: float, cover: int) -> Box:
        return block(middle, base, (0.3, 0.21, 0.045), yaw, [white, white, cover, cover, cover, cover])

    boxes = [
        Box((0, 0, 0), ROOM, faces_of_room, room=True),
        Box((0.875, 0, 0.8), (0.875 + POSTER[0], 0.045, 0.8 + POSTER[1]), [dark] * 3 + [poster] + [dark] * 2),
        Box((0, 0.65, 1.15), (0.04, 1.4, 1.7), [dark, small, dark, dark, dark, dark]),
        block((1.4, 0.24), 0, sideboard, 0, [side, side, walnut, front, walnut, top]),
        book((0.97, 0.24), 0.56, 12, spines[0]),
        book((0.98, 0.23), 0.605, -8, spines[1]),
        book((0.96, 0.24), 0.65, 21, spines[3]),
        block((2.6, 0.75), 0, (0.4, 0.4, 0.4), 28, [checks[0], checks[1], checks[1], checks[0], checks[2], checks[2]]),
        block(
            (2.62, 0.76), 0.4, (0.2, 0.2, 0.2), 55, [checks[2], checks[0], checks[0], checks[2], checks[1], checks[1]]
        ),
        block((0.32, 0.42), 0, (0.13, 0.13, 1.55), 40, [rings] * 4 + [white, white]),
        block((1.3, 1.35), 0, (0.6, 0.42, 0.3), -14, [side, side, side, side, walnut, magazine]),
        Box((1.3, 1.6, 2.55), (2.5, 2.8, 2.59), [white] * 6, light=LAMP),
        Box((3.87, 1.4, 0.9), (3.9, 3.0, 2.2), [panes] * 6, light=WINDOW),
    ]
    balls = [
        Ball((1.77, 0.24, 0.56 + 0.17), 0.17, silver, 0.88),
        Ball((0.5, 1.0, 0.19), 0.19, swirl, 0.05),
        Ball((2.05, 1.05, 0.13), 0.13, atlas.add(paint.plain("2c6e49")), 0.05),
    ]
    world = World(boxes, balls, atlas)
    bake(
        world,
        [
            Panel((1.3, 1.6, 2.545), ((1.2, 0, 0), (0, 1.2, 0)), (0, 0, -1), LAMP * np.array([1.0, 0.93, 0.82])),
            Panel((3.865, 1.4, 0.9), ((0, 1.6, 0), (0, 0, 1.3)), (-1, 0, 0), WINDOW * np.array([0.62, 0.7, 0.8])),
        ],
    )
    return world


def walk(views: int, seed: int) -> NDArray:
    """Camera-to-world poses (V, 3, 4), metres, of a hand-held camera that moves to and fro before the poster."""
    random = np.random.default_rng(seed)
    time = np.arange(views) / max(views - 1, 1)

    def sway(cycles: float, shake: float) -> NDArray:
        """A smooth curve (V,), mostly within [-1, 1]: a slow wave and the tremor of a hand."""
        phases = random.random(4) * 2 * np.pi
        curve = np.sin(2 * np.pi * cycles * time + phases[0])
        for harmonic, phase in zip((9, 14, 23), phases[1:], strict=True):
            curve = curve + shake / 3 * np.sin(2 * np.pi * harmonic * time + phase)
        return curve

    centre = np.stack([1.75 + 1.2 * sway(2.0, 0.1), 2.15 + 0.65 * sway(3.3, 0.1), 1.25 + 0.42 * sway(5.2, 0.1)], axis=1)
    target = np.stack([1.25 + 0.55 * sway(4.1, 0.2), np.full(views, 0.2), 0.98 + 0.28 * sway(2.7, 0.2)], axis=1)
    roll = radians(3.0) * sway(6.0, 0.5)
    backward = centre - target
    backward /= np.sqrt((backward**2).sum(1, keepdims=True))
    right = np.cross([0.0, 0, 1], backward)
    right /= np.sqrt((right**2).sum(1, keepdims=True))
    up = np.cross(backward, right)
    cosine, sine = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cosine * right + sine * up, cosine * up - sine * right, backward, centre], axis=2)
