"""A small deterministic ray tracer for rooms of boxes and balls, with textures, baked light and mirrors.

Lengths are metres and z is up. Light is baked once (light.py) and looked up, so it is the same in every view. All
arithmetic is elementwise numpy, so equal inputs give equal bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.builtin.atlas import Atlas, bilinear

EPSILON = 1e-4  # metres from a surface at which a reflected ray starts
LIGHT_CELL = 0.08  # metres: side of a cell of baked light
FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
MAX_RADIANCE = 1.6  # of one ray, where white is 1: else lamps in the mirror ball would sparkle


@dataclass(frozen=True)
class Box:
    """A box, turned by `yaw` about the vertical axis through its middle. A `room` is seen from inside."""

    low: Sequence[float]
    high: Sequence[float]
    faces: Sequence[int]  # texture of each of FACES, named by the visible side
    yaw: float = 0.0  # radians
    room: bool = False
    light: float = 0.0  # emitted radiance of a white texel

    @property
    def middle(self) -> NDArray:
        return (np.asarray(self.low) + np.asarray(self.high)) / 2


@dataclass(frozen=True)
class Ball:
    """A sphere, textured and possibly mirroring."""

    centre: Sequence[float]
    radius: float
    texture: int
    mirror: float  # reflectance at normal incidence; Schlick's formula raises it at grazing angles


@dataclass(frozen=True)
class Hits:
    """The first hits of M rays."""

    distance: NDArray  # (M,) along the unit direction; inf: no hit
    surface: NDArray  # (M,) int32: 6 * box + face; balls follow all boxes
    u: NDArray  # (M,) in [0, 1], to the right
    v: NDArray  # (M,) down
    normal: NDArray  # (3, M) unit, towards the ray


class World:
    """Boxes, balls, their textures and their baked light."""

    def __init__(self, boxes: Sequence[Box], balls: Sequence[Ball], atlas: Atlas) -> None:
        self.boxes, self.balls, self.atlas = list(boxes), list(balls), atlas.packed()
        self.first_ball = 6 * len(self.boxes)
        self.texture = np.array(
            [texture for box in self.boxes for texture in box.faces] + [ball.texture for ball in self.balls], np.int32
        )
        self.shine = np.array([box.light for box in self.boxes for _ in FACES] + [0.0 for _ in self.balls], np.float32)
        self.mirror = np.array([0.0 for _ in range(self.first_ball)] + [ball.mirror for ball in self.balls], np.float32)
        self.extent = np.array(
            [size for box in self.boxes for size in _face_sizes(box)]
            + [(2 * np.pi * ball.radius, np.pi * ball.radius) for ball in self.balls]
        )
        widest = np.maximum(
            self.atlas.width[self.texture, 0] / self.extent[:, 0],
            self.atlas.height[self.texture, 0] / self.extent[:, 1],
        )
        self.density = widest.astype(np.float32)  # texels a metre
        cells = np.clip(np.ceil(self.extent / LIGHT_CELL), 2, 64).astype(np.int32)
        self.light_width, self.light_height = cells[:, 0], cells[:, 1]
        self.light_offset = np.concatenate([[0], np.cumsum(cells[:, 0] * cells[:, 1])]).astype(np.int32)
        self.light = np.zeros((int(self.light_offset[-1]), 3), np.float32)

    def trace(self, origin: NDArray, direction: NDArray) -> Hits:
        """First hits of rays: origins and unit directions (3, M), float32 or float64."""
        kind = direction.dtype
        count = direction.shape[1]
        best = np.full(count, np.inf, kind)
        which = np.full(count, -1, np.int32)
        for index, box in enumerate(self.boxes):
            enter, leave = _slabs(box, origin, direction)
            if box.room:
                hit = leave < best
                best = np.where(hit, leave, best)
            else:
                hit = (enter < leave) & (enter > 0) & (enter < best)
                best = np.where(hit, enter, best)
            which[hit] = index
        for index, ball in enumerate(self.balls):
            distance = _ball_distance(ball, origin, direction)
            hit = distance < best
            best = np.where(hit, distance, best)
            which[hit] = len(self.boxes) + index
        surface = np.full(count, -1, np.int32)
        u, v, normal = np.zeros(count, kind), np.zeros(count, kind), np.zeros((3, count), kind)
        for index in range(len(self.boxes) + len(self.balls)):
            chosen = np.flatnonzero(which == index)
            if chosen.size:
                start = origin if origin.shape[1] == 1 else origin[:, chosen]
                point = start + direction[:, chosen] * best[chosen]
                surface[chosen], u[chosen], v[chosen], normal[:, chosen] = self._surface_coordinates(index, point)
        return Hits(best, surface, u, v, normal)

    def blocked(self, origin: NDArray, direction: NDArray, distance: NDArray) -> NDArray:
        """Whether anything but a lamp is hit within `distance` (M,) along the rays: (M,) bool."""
        shadow = np.zeros(direction.shape[1], bool)
        for box in self.boxes:
            if not box.room and not box.light:
                enter, leave = _slabs(box, origin, direction)
                shadow |= (enter < leave) & (leave > 0) & (enter < distance)
        for ball in self.balls:
            shadow |= _ball_distance(ball, origin, direction) < distance
        return shadow

    def clearance(self, points: NDArray) -> NDArray:
        """Signed distance (M,) of points (3, M) to the nearest surface; negative outside the room or in an object."""
        nearest = np.full(points.shape[1], np.inf)
        for box in self.boxes:
            local = _rotated(points - box.middle[:, None], -box.yaw)
            half = (np.asarray(box.high) - np.asarray(box.low))[:, None] / 2
            beyond = np.abs(local) - half
            distance = np.sqrt((np.maximum(beyond, 0) ** 2).sum(0)) + np.minimum(beyond.max(0), 0)
            nearest = np.minimum(nearest, -distance if box.room else distance)
        for ball in self.balls:
            distance = np.sqrt(((points - np.asarray(ball.centre)[:, None]) ** 2).sum(0)) - ball.radius
            nearest = np.minimum(nearest, distance)
        return nearest

    def _surface_coordinates(self, index: int, point: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Surface, u, v and normal of points (3, M) on box or ball `index`."""
        kind = point.dtype
        if index >= len(self.boxes):
            ball = self.balls[index - len(self.boxes)]
            normal = ((point - np.asarray(ball.centre, kind)[:, None]) / kind.type(ball.radius)).astype(kind)
            u = np.arctan2(normal[1], normal[0]) / kind.type(2 * np.pi) + kind.type(0.5)
            v = np.arccos(np.clip(normal[2], -1, 1)) / kind.type(np.pi)
            surface = np.full(point.shape[1], self.first_ball + index - len(self.boxes), np.int32)
            return surface, u, v, normal
        box = self.boxes[index]
        half = (np.asarray(box.high, kind) - np.asarray(box.low, kind))[:, None] / 2
        local = _rotated(point - box.middle.astype(kind)[:, None], -box.yaw) / half
        axis = np.argmax(np.abs(local), axis=0)
        outward = np.take_along_axis(local, axis[None], 0)[0] > 0
        face = (2 * axis + (outward ^ box.room)).astype(np.int32)  # a room is seen from inside
        q = np.clip((local + 1) / 2, 0, 1)
        u = np.choose(face, [1 - q[1], q[1], q[0], 1 - q[0], q[0], q[0]])
        v = np.choose(face, [1 - q[2], 1 - q[2], 1 - q[2], 1 - q[2], q[1], 1 - q[1]])
        normal = np.zeros_like(local)
        np.put_along_axis(normal, axis[None], np.where(face % 2 == 1, 1, -1).astype(kind)[None], 0)
        return 6 * index + face, u, v, _rotated(normal, box.yaw)

    def radiance(self, origin: NDArray, direction: NDArray, ray_angle: float, mirrors: bool = True) -> NDArray:
        """Linear colours (M, 3) seen along rays; `ray_angle` is the angle in radians between neighbouring rays."""
        hits = self.trace(origin, direction)
        color = self.surface_color(hits, ray_angle, direction)
        share = self.mirror[hits.surface]
        chosen = np.flatnonzero(share > 0) if mirrors else np.zeros(0, int)
        if chosen.size:
            start = origin if origin.shape[1] == 1 else origin[:, chosen]
            heading, normal = direction[:, chosen], hits.normal[:, chosen]
            cosine = -(heading * normal).sum(0)
            bounced = heading + 2 * cosine * normal
            point = start + heading * hits.distance[chosen] + normal * np.float32(EPSILON)
            # Reflection on a ball makes the angle between neighbouring rays about four times as large.
            reflected = self.radiance(point, bounced, 4 * ray_angle, mirrors=False)
            fresnel = (share[chosen] + (1 - share[chosen]) * (1 - np.clip(cosine, 0, 1)) ** 5)[:, None]
            color[chosen] = color[chosen] * (1 - fresnel) + reflected * fresnel
        return color

    def surface_color(self, hits: Hits, ray_angle: float, direction: NDArray) -> NDArray:
        """Albedo times baked light, or the emitted light of a lamp: (M, 3)."""
        cosine = np.abs((hits.normal * direction).sum(0))
        footprint = hits.distance * np.float32(ray_angle) / np.sqrt(np.maximum(cosine, 0.05))
        level = np.log2(np.maximum(footprint * self.density[hits.surface], 1e-6))
        albedo = self.atlas.sample(self.texture[hits.surface], hits.u, hits.v, level)
        shine = self.shine[hits.surface][:, None]
        return albedo * np.where(shine > 0, shine, self.baked(hits.surface, hits.u, hits.v))

    def baked(self, surface: NDArray, u: NDArray, v: NDArray) -> NDArray:
        """Baked light (M, 3) on surfaces (M,) at u, v: the radiance of a white texel."""
        offset, height, width = self.light_offset[surface], self.light_height[surface], self.light_width[surface]
        return bilinear(self.light, offset, height, width, u, v)

    def light_cells(self, surface: int) -> tuple[slice, tuple[int, int]]:
        """Where `light` has the cells of a surface, and their grid (h, w)."""
        cells = slice(self.light_offset[surface], self.light_offset[surface + 1])
        return cells, (self.light_height[surface], self.light_width[surface])

    def surface_points(self, surface: NDArray, u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
        """World points and normals (3, M) of surfaces (M,) at u, v: the inverse of `_surface_coordinates`."""
        point, normal = np.zeros((3, len(surface))), np.zeros((3, len(surface)))
        for index, ball in enumerate(self.balls):
            chosen = surface == self.first_ball + index
            around, down = 2 * np.pi * (u[chosen] - 0.5), np.pi * v[chosen]
            n = np.stack([np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)])
            normal[:, chosen], point[:, chosen] = n, np.asarray(ball.centre)[:, None] + ball.radius * n
        for index, box in enumerate(self.boxes):
            half = (np.asarray(box.high) - np.asarray(box.low))[:, None] / 2
            for face in range(6):
                chosen = surface == 6 * index + face
                axis, sign = face // 2, 1.0 if face % 2 else -1.0
                a, b = u[chosen], v[chosen]
                one = np.full_like(a, float(bool(face % 2) ^ box.room))
                q = {
                    0: (one, 1 - a, 1 - b),
                    1: (one, a, 1 - b),
                    2: (a, one, 1 - b),
                    3: (1 - a, one, 1 - b),
                    4: (a, b, one),
                    5: (a, 1 - b, one),
                }[face]
                local = (2 * np.stack(q) - 1) * half
                point[:, chosen] = _rotated(local, box.yaw) + box.middle[:, None]
                direction = np.zeros((3, len(a)))
                direction[axis] = sign
                normal[:, chosen] = _rotated(direction, box.yaw)
        return point, normal


def _face_sizes(box: Box) -> list[tuple[float, float]]:
    """Width and height of each of FACES, metres."""
    x, y, z = (float(size) for size in np.asarray(box.high) - np.asarray(box.low))
    return [(y, z), (y, z), (x, z), (x, z), (x, y), (x, y)]


def _rotated(vector: NDArray, angle: float) -> NDArray:
    """Vectors (3, M) rotated about z by `angle` radians."""
    if angle == 0:
        return vector
    cosine, sine = vector.dtype.type(np.cos(angle)), vector.dtype.type(np.sin(angle))
    return np.stack([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1], vector[2]])


def _slabs(box: Box, origin: NDArray, direction: NDArray) -> tuple[NDArray, NDArray]:
    """Distances (M,) at which rays enter and leave the box. A ray misses it if it enters after it leaves."""
    kind = direction.dtype.type
    start = _rotated(origin - box.middle.astype(kind)[:, None], -box.yaw)
    heading = _rotated(direction, -box.yaw)
    heading = np.where(np.abs(heading) < 1e-9, kind(1e-9), heading)
    half = ((np.asarray(box.high) - np.asarray(box.low)) / 2).astype(kind)[:, None]
    middle, reach = -start / heading, half / np.abs(heading)
    enter, leave = middle - reach, middle + reach
    return (
        np.maximum(np.maximum(enter[0], enter[1]), enter[2]),
        np.minimum(np.minimum(leave[0], leave[1]), leave[2]),
    )


def _ball_distance(ball: Ball, origin: NDArray, direction: NDArray) -> NDArray:
    """Distance (M,) at which rays from outside hit the ball; inf if they miss it."""
    kind = direction.dtype.type
    offset = origin - np.asarray(ball.centre, direction.dtype)[:, None]
    along = offset[0] * direction[0] + offset[1] * direction[1] + offset[2] * direction[2]
    nearest = offset - along * direction  # perpendicular to the ray: keeps its digits far away
    chord = kind(ball.radius**2) - (nearest[0] ** 2 + nearest[1] ** 2 + nearest[2] ** 2)
    distance = -along - np.sqrt(np.maximum(chord, 0))
    return np.where((chord > 0) & (distance > 0), distance, kind(np.inf))


def cross(a: NDArray, b: NDArray) -> NDArray:
    """Cross products of vectors (3, M)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
