"""A small deterministic ray tracer for rooms of boxes and balls: textures, baked light, mirrors.

World units are metres, z is up. Light is computed once for points spread over every surface (two area lights with
shadows, then two bounces of diffuse light) and looked up afterwards, so that it is the same in every view. Everything
is elementwise numpy, so that equal inputs give equal bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.textures import Picture

EPSILON = 1e-4  # metres: where a ray that leaves a surface starts
LIGHT_CELL = 0.08  # metres: size of a cell of baked light
FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
BRIGHTEST = 1.6  # radiance of one ray, in units of a white picture: a lamp seen in a mirror must not sparkle


@dataclass(frozen=True)
class Box:
    """An axis-aligned box turned by `yaw` about the vertical axis through its middle; a room if `room`."""

    low: Sequence[float]
    high: Sequence[float]
    faces: Sequence[int]  # texture of each of FACES, by the side that is seen
    yaw: float = 0.0  # radians
    room: bool = False
    light: float = 0.0  # radiance of a white texel; 0: does not shine

    @property
    def middle(self) -> NDArray:
        return (np.asarray(self.low) + np.asarray(self.high)) / 2


@dataclass(frozen=True)
class Ball:
    centre: Sequence[float]
    radius: float
    texture: int
    mirror: float  # reflected share at normal incidence; grows towards grazing by Schlick's formula


@dataclass
class Atlas:
    """Textures with their pyramids of halved copies, all texels in one array."""

    texels: list[Picture] = field(default_factory=list)
    offsets: list[list[int]] = field(default_factory=list)
    shapes: list[list[tuple[int, int]]] = field(default_factory=list)
    total: int = 0

    def add(self, picture: Picture) -> int:
        offsets, shapes = [], []
        level = np.asarray(picture, np.float32)
        while True:
            height, width = level.shape[:2]
            offsets.append(self.total)
            shapes.append((height, width))
            self.texels.append(level.reshape(-1, 3))
            self.total += height * width
            if min(height, width) < 2 or height % 2 or width % 2:
                break
            level = (level[0::2, 0::2] + level[1::2, 0::2] + level[0::2, 1::2] + level[1::2, 1::2]) * np.float32(0.25)
        self.offsets.append(offsets)
        self.shapes.append(shapes)
        return len(self.offsets) - 1

    def packed(self) -> "PackedAtlas":
        levels = max(map(len, self.offsets))
        offset, height, width = (np.zeros((len(self.offsets), levels), np.int32) for _ in range(3))
        for index, (offsets, shapes) in enumerate(zip(self.offsets, self.shapes, strict=True)):
            for level in range(levels):  # the coarsest level stands in for all beyond
                at = min(level, len(offsets) - 1)
                offset[index, level] = offsets[at]
                height[index, level], width[index, level] = shapes[at]
        return PackedAtlas(np.concatenate(self.texels), offset, height, width)


@dataclass(frozen=True)
class PackedAtlas:
    texels: NDArray  # (texels, 3)
    offset: NDArray  # (textures, levels)
    height: NDArray
    width: NDArray

    def sample(self, texture: NDArray, u: NDArray, v: NDArray, level: NDArray) -> NDArray:
        """Colours (M, 3) of textures (M,) at u to the right and v down, in [0, 1], at fractional pyramid levels (M,)."""
        level = np.clip(level, 0, self.offset.shape[1] - 1)
        low = level.astype(np.int32)
        part = (level - low).astype(np.float32)[:, None]
        high = np.minimum(low + 1, self.offset.shape[1] - 1)
        return self._bilinear(texture, u, v, low) * (1 - part) + self._bilinear(texture, u, v, high) * part

    def _bilinear(self, texture: NDArray, u: NDArray, v: NDArray, level: NDArray) -> NDArray:
        offset, height, width = self.offset[texture, level], self.height[texture, level], self.width[texture, level]
        return bilinear(self.texels, offset, height, width, u, v)


def bilinear(texels: NDArray, offset: NDArray, height: NDArray, width: NDArray, u: NDArray, v: NDArray) -> NDArray:
    """Values (M, C) between the texel centres of pictures that begin at texels[offset], clamped at their borders."""
    x = np.clip(u * width - np.float32(0.5), 0, width - 1).astype(np.float32)
    y = np.clip(v * height - np.float32(0.5), 0, height - 1).astype(np.float32)
    x0, y0 = x.astype(np.int32), y.astype(np.int32)
    right = np.minimum(x0 + 1, width - 1) - x0
    below = np.where(y0 + 1 < height, width, 0).astype(np.int32)
    s, t = (x - x0)[:, None], (y - y0)[:, None]
    at = offset + y0 * width + x0
    top = np.take(texels, at, 0) * (1 - s) + np.take(texels, at + right, 0) * s
    at = at + below
    return top * (1 - t) + (np.take(texels, at, 0) * (1 - s) + np.take(texels, at + right, 0) * s) * t


@dataclass(frozen=True)
class Hits:
    """What M rays meet first."""

    distance: NDArray  # (M,) along the unit direction; inf where nothing
    surface: NDArray  # (M,) int32: 6 box + face, balls after all boxes
    u: NDArray  # (M,) in [0, 1], to the right
    v: NDArray  # (M,) down
    normal: NDArray  # (3, M) unit, towards the ray


class World:
    """Boxes, balls and their textures, with the light baked in."""

    def __init__(self, boxes: Sequence[Box], balls: Sequence[Ball], atlas: Atlas) -> None:
        self.boxes, self.balls, self.atlas = list(boxes), list(balls), atlas.packed()
        self.first_ball = 6 * len(self.boxes)
        self.texture = np.array(
            [texture for box in self.boxes for texture in box.faces] + [ball.texture for ball in self.balls], np.int32
        )
        self.shine = np.array(
            [box.light for box in self.boxes for _ in FACES] + [0.0 for _ in self.balls], np.float32
        )
        self.mirror = np.array(
            [0.0 for _ in range(self.first_ball)] + [ball.mirror for ball in self.balls], np.float32
        )
        self.extent = np.array(
            [size for box in self.boxes for size in _face_sizes(box)]
            + [(2 * np.pi * ball.radius, np.pi * ball.radius) for ball in self.balls]
        )
        widest = np.maximum(
            self.atlas.width[self.texture, 0] / self.extent[:, 0], self.atlas.height[self.texture, 0] / self.extent[:, 1]
        )
        self.density = widest.astype(np.float32)  # texels a metre
        cells = np.clip(np.ceil(self.extent / LIGHT_CELL), 2, 64).astype(np.int32)
        self.light_width, self.light_height = cells[:, 0], cells[:, 1]
        self.light_offset = np.concatenate([[0], np.cumsum(cells[:, 0] * cells[:, 1])]).astype(np.int32)
        self.light = np.zeros((int(self.light_offset[-1]), 3), np.float32)

    # --- geometry

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
                surface[chosen], u[chosen], v[chosen], normal[:, chosen] = self._locate(index, point)
        return Hits(best, surface, u, v, normal)

    def blocked(self, origin: NDArray, direction: NDArray, distance: NDArray) -> NDArray:
        """Whether anything that does not shine lies within `distance` (M,) along the rays."""
        shadow = np.zeros(direction.shape[1], bool)
        for box in self.boxes:
            if not box.room and not box.light:
                enter, leave = _slabs(box, origin, direction)
                shadow |= (enter < leave) & (leave > 0) & (enter < distance)
        for ball in self.balls:
            shadow |= _ball_distance(ball, origin, direction) < distance
        return shadow

    def clearance(self, points: NDArray) -> NDArray:
        """Distance (M,) of points (3, M) to the nearest surface; negative outside the room or inside a thing."""
        least = np.full(points.shape[1], np.inf)
        for box in self.boxes:
            local = _turned(points - box.middle[:, None], -box.yaw)
            half = (np.asarray(box.high) - np.asarray(box.low))[:, None] / 2
            beyond = np.abs(local) - half
            distance = np.sqrt((np.maximum(beyond, 0) ** 2).sum(0)) + np.minimum(beyond.max(0), 0)
            least = np.minimum(least, -distance if box.room else distance)
        for ball in self.balls:
            distance = np.sqrt(((points - np.asarray(ball.centre)[:, None]) ** 2).sum(0)) - ball.radius
            least = np.minimum(least, distance)
        return least

    def _locate(self, index: int, point: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
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
        local = _turned(point - box.middle.astype(kind)[:, None], -box.yaw) / half
        axis = np.argmax(np.abs(local), axis=0)
        outward = np.take_along_axis(local, axis[None], 0)[0] > 0
        face = (2 * axis + (outward ^ box.room)).astype(np.int32)  # a room is seen from inside
        q = np.clip((local + 1) / 2, 0, 1)
        u = np.choose(face, [1 - q[1], q[1], q[0], 1 - q[0], q[0], q[0]])
        v = np.choose(face, [1 - q[2], 1 - q[2], 1 - q[2], 1 - q[2], q[1], 1 - q[1]])
        normal = np.zeros_like(local)
        np.put_along_axis(normal, axis[None], np.where(face % 2 == 1, 1, -1).astype(kind)[None], 0)
        return 6 * index + face, u, v, _turned(normal, box.yaw)

    # --- light

    def radiance(self, origin: NDArray, direction: NDArray, spread: float, mirrors: bool = True) -> NDArray:
        """Linear colours (M, 3) seen along rays; `spread` is the angle in radians between neighbouring rays."""
        hits = self.trace(origin, direction)
        color = self.surface_color(hits, spread, direction)
        share = self.mirror[hits.surface]
        chosen = np.flatnonzero(share > 0) if mirrors else np.zeros(0, int)
        if chosen.size:
            start = origin if origin.shape[1] == 1 else origin[:, chosen]
            heading, normal = direction[:, chosen], hits.normal[:, chosen]
            cosine = -(heading * normal).sum(0)
            bounced = heading + 2 * cosine * normal
            point = start + heading * hits.distance[chosen] + normal * np.float32(EPSILON)
            # A ball spreads neighbouring rays apart by about four times their angle.
            reflected = self.radiance(point, bounced, 4 * spread, mirrors=False)
            fresnel = (share[chosen] + (1 - share[chosen]) * (1 - np.clip(cosine, 0, 1)) ** 5)[:, None]
            color[chosen] = color[chosen] * (1 - fresnel) + reflected * fresnel
        return color

    def surface_color(self, hits: Hits, spread: float, direction: NDArray) -> NDArray:
        """Albedo times baked light, or what the surface shines with: (M, 3)."""
        cosine = np.abs((hits.normal * direction).sum(0))
        footprint = hits.distance * np.float32(spread) / np.sqrt(np.maximum(cosine, 0.05))
        level = np.log2(np.maximum(footprint * self.density[hits.surface], 1e-6))
        albedo = self.atlas.sample(self.texture[hits.surface], hits.u, hits.v, level)
        shine = self.shine[hits.surface][:, None]
        return albedo * np.where(shine > 0, shine, self.baked(hits.surface, hits.u, hits.v))

    def baked(self, surface: NDArray, u: NDArray, v: NDArray) -> NDArray:
        """Light (M, 3) that falls on surfaces (M,) at u, v; a white texel is seen as bright as that."""
        offset, height, width = self.light_offset[surface], self.light_height[surface], self.light_width[surface]
        return bilinear(self.light, offset, height, width, u, v)

    def bake(self, lights: Sequence["Panel"], gathered: int = 64, bounces: int = 2) -> None:
        """Fills in the light of every surface: direct from the panels, then `bounces` of `gathered` rays a cell."""
        surface = np.repeat(np.arange(len(self.texture), dtype=np.int32), np.diff(self.light_offset))
        inner = np.arange(len(surface), dtype=np.int32) - self.light_offset[surface]
        u = (inner % self.light_width[surface] + 0.5) / self.light_width[surface]
        v = (inner // self.light_width[surface] + 0.5) / self.light_height[surface]
        point, normal = self._place(surface, u, v)
        point = point + normal * 10 * EPSILON
        buried = self.clearance(point) < 0

        direct = np.zeros((len(surface), 3))
        for panel in lights:
            for spot in panel.spots():
                towards = spot[:, None] - point
                square = (towards**2).sum(0)
                distance = np.sqrt(square)
                towards = towards / distance
                received = (towards * normal).sum(0)
                sent = -(towards * np.asarray(panel.normal)[:, None]).sum(0)
                lit = np.flatnonzero((received > 0) & (sent > 0) & ~buried)
                lit = lit[~self.blocked(point[:, lit], towards[:, lit], distance[lit])]
                strength = received[lit] * sent[lit] / square[lit] * panel.area / panel.count / np.pi
                direct[lit] += strength[:, None] * np.asarray(panel.radiance)
        self.light = self._filled(direct, buried).astype(np.float32)

        open_cells = np.flatnonzero(~buried)
        direct, total = self.light.copy(), np.zeros_like(direct)
        hits = [self._gather(point, normal, open_cells, index, gathered) for index in range(gathered)]
        for _ in range(bounces):
            total[:] = 0
            for hit_surface, hit_u, hit_v, albedo in hits:
                total[open_cells] += albedo * self.baked(hit_surface, hit_u, hit_v)
            bounced = self._smoothed(self._filled(total / gathered, buried))
            self.light = (direct + bounced).astype(np.float32)

    def _gather(
        self, point: NDArray, normal: NDArray, cells: NDArray, index: int, count: int
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """What ray `index` of `count` over each cell's hemisphere, denser along the normal, meets: surface, u, v, albedo."""
        shift = np.random.default_rng(7).random((2, len(cells)))
        a = ((index + 0.5) / count + shift[0]) % 1
        b = (index * 0.6180339887498949 + shift[1]) % 1
        radius, angle = np.sqrt(a), 2 * np.pi * b
        n = normal[:, cells]
        helper = np.where(np.abs(n[2]) > 0.9, np.array([[1.0], [0], [0]]), np.array([[0.0], [0], [1]]))
        tangent = _cross(helper, n)
        tangent /= np.sqrt((tangent**2).sum(0))
        other = _cross(n, tangent)
        direction = tangent * radius * np.cos(angle) + other * radius * np.sin(angle) + n * np.sqrt(1 - a)
        hits = self.trace(point[:, cells].astype(np.float32), direction.astype(np.float32))
        dark = self.shine[hits.surface] > 0  # lights were counted directly
        level = np.full(len(cells), 5, np.float32)
        albedo = self.atlas.sample(self.texture[hits.surface], hits.u, hits.v, level)
        return hits.surface, hits.u, hits.v, np.where(dark[:, None], 0, albedo)

    def _place(self, surface: NDArray, u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
        """World points and normals (3, M) of surfaces (M,) at u, v: the inverse of `_locate`."""
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
                point[:, chosen] = _turned(local, box.yaw) + box.middle[:, None]
                direction = np.zeros((3, len(a)))
                direction[axis] = sign
                normal[:, chosen] = _turned(direction, box.yaw)
        return point, normal

    def _filled(self, light: NDArray, buried: NDArray) -> NDArray:
        """Cells inside things take the mean of their neighbours, so that no dark seam shows where things touch."""
        light = light.copy()
        for surface in range(len(self.texture)):
            part = slice(self.light_offset[surface], self.light_offset[surface + 1])
            shape = (self.light_height[surface], self.light_width[surface])
            known = ~buried[part].reshape(shape)
            values = light[part].reshape(*shape, 3)
            while not known.all() and known.any():
                weight = _neighbours(known.astype(float)[..., None])
                mean = _neighbours(values * known[..., None]) / np.maximum(weight, 1)
                reached = ~known & (weight[..., 0] > 0)
                values = np.where(reached[..., None], mean, values)
                known = known | reached
            light[part] = values.reshape(-1, 3)
        return light

    def _smoothed(self, light: NDArray) -> NDArray:
        """Means over 3 x 3 cells of each surface."""
        light = light.copy()
        for surface in range(len(self.texture)):
            part = slice(self.light_offset[surface], self.light_offset[surface + 1])
            shape = (self.light_height[surface], self.light_width[surface])
            values = light[part].reshape(*shape, 3)
            light[part] = (_neighbours(values) / _neighbours(np.ones((*shape, 1)))).reshape(-1, 3)
        return light


@dataclass(frozen=True)
class Panel:
    """A shining rectangle for direct light: a corner, two edges, the direction in which it shines."""

    corner: Sequence[float]
    edges: tuple[Sequence[float], Sequence[float]]
    normal: Sequence[float]
    radiance: Sequence[float]
    side: int = 7  # spots along each edge

    @property
    def count(self) -> int:
        return self.side**2

    @property
    def area(self) -> float:
        a, b = np.asarray(self.edges[0]), np.asarray(self.edges[1])
        return float(np.sqrt((_cross(a[:, None], b[:, None]) ** 2).sum()))

    def spots(self) -> list[NDArray]:
        steps = (np.arange(self.side) + 0.5) / self.side
        a, b = (np.asarray(edge) for edge in self.edges)
        return [np.asarray(self.corner) + a * s + b * t for s in steps for t in steps]


def _face_sizes(box: Box) -> list[tuple[float, float]]:
    x, y, z = (float(size) for size in np.asarray(box.high) - np.asarray(box.low))
    return [(y, z), (y, z), (x, z), (x, z), (x, y), (x, y)]


def _turned(vector: NDArray, angle: float) -> NDArray:
    """Vectors (3, M) turned about z."""
    if angle == 0:
        return vector
    cosine, sine = vector.dtype.type(np.cos(angle)), vector.dtype.type(np.sin(angle))
    return np.stack([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1], vector[2]])


def _slabs(box: Box, origin: NDArray, direction: NDArray) -> tuple[NDArray, NDArray]:
    """Distances (M,) at which rays enter and leave the box; it is missed where they enter after they leave."""
    kind = direction.dtype.type
    start = _turned(origin - box.middle.astype(kind)[:, None], -box.yaw)
    heading = _turned(direction, -box.yaw)
    heading = np.where(np.abs(heading) < 1e-9, kind(1e-9), heading)
    half = ((np.asarray(box.high) - np.asarray(box.low)) / 2).astype(kind)[:, None]
    middle, reach = -start / heading, half / np.abs(heading)
    enter, leave = middle - reach, middle + reach
    return (
        np.maximum(np.maximum(enter[0], enter[1]), enter[2]),
        np.minimum(np.minimum(leave[0], leave[1]), leave[2]),
    )


def _ball_distance(ball: Ball, origin: NDArray, direction: NDArray) -> NDArray:
    """Distance (M,) at which rays from outside meet the ball; inf where they miss it."""
    kind = direction.dtype.type
    offset = origin - np.asarray(ball.centre, direction.dtype)[:, None]
    along = offset[0] * direction[0] + offset[1] * direction[1] + offset[2] * direction[2]
    nearest = offset - along * direction  # at right angles: no digits are lost far away
    room = kind(ball.radius**2) - (nearest[0] ** 2 + nearest[1] ** 2 + nearest[2] ** 2)
    distance = -along - np.sqrt(np.maximum(room, 0))
    return np.where((room > 0) & (distance > 0), distance, kind(np.inf))


def _cross(a: NDArray, b: NDArray) -> NDArray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _neighbours(values: NDArray) -> NDArray:
    """Sums over the 3 x 3 cells around each (h, w, C), nothing beyond the border."""
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
