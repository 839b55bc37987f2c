"""Baked light: the irradiance on a grid of cells over every surface of the room."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.builtin.tracer import EPSILON, World, cross


@dataclass(frozen=True)
class Panel:
    """A rectangular area light: a corner, two edges, the direction in which it shines."""

    corner: Sequence[float]
    edges: tuple[Sequence[float], Sequence[float]]
    normal: Sequence[float]
    radiance: NDArray
    side: int = 7  # point lights along each edge

    @property
    def count(self) -> int:
        return self.side**2

    @property
    def area(self) -> float:
        a, b = np.asarray(self.edges[0]), np.asarray(self.edges[1])
        return float(np.sqrt((cross(a[:, None], b[:, None]) ** 2).sum()))

    def points(self) -> list[NDArray]:
        """The point lights (3,) that stand in for the area."""
        steps = (np.arange(self.side) + 0.5) / self.side
        a, b = (np.asarray(edge) for edge in self.edges)
        return [np.asarray(self.corner) + a * s + b * t for s in steps for t in steps]


def bake(world: World, lights: Sequence[Panel], rays: int = 64, bounces: int = 2) -> None:
    """Computes `world.light`: direct light with soft shadows, then `bounces` of indirect light.

    Indirect light is gathered by `rays` cosine-weighted rays from each cell.
    """
    surface = np.repeat(np.arange(len(world.texture), dtype=np.int32), np.diff(world.light_offset))
    inner = np.arange(len(surface), dtype=np.int32) - world.light_offset[surface]
    u = (inner % world.light_width[surface] + 0.5) / world.light_width[surface]
    v = (inner // world.light_width[surface] + 0.5) / world.light_height[surface]
    point, normal = world.surface_points(surface, u, v)
    point = point + normal * 10 * EPSILON
    buried = world.clearance(point) < 0

    falling = np.zeros((len(surface), 3))
    for panel in lights:
        for source in panel.points():
            towards = source[:, None] - point
            square = (towards**2).sum(0)
            distance = np.sqrt(square)
            towards = towards / distance
            received = (towards * normal).sum(0)
            sent = -(towards * np.asarray(panel.normal)[:, None]).sum(0)
            lit = np.flatnonzero((received > 0) & (sent > 0) & ~buried)
            lit = lit[~world.blocked(point[:, lit], towards[:, lit], distance[lit])]
            strength = received[lit] * sent[lit] / square[lit] * panel.area / panel.count / np.pi
            falling[lit] += strength[:, None] * np.asarray(panel.radiance)
    world.light = _filled(world, falling, buried).astype(np.float32)

    open_cells = np.flatnonzero(~buried)
    direct, total = world.light.copy(), np.zeros_like(falling)
    hits = [_gather(world, point, normal, open_cells, index, rays) for index in range(rays)]
    for _ in range(bounces):
        total[:] = 0
        for hit_surface, hit_u, hit_v, albedo in hits:
            total[open_cells] += albedo * world.baked(hit_surface, hit_u, hit_v)
        bounced = _smoothed(world, _filled(world, total / rays, buried))
        world.light = (direct + bounced).astype(np.float32)


def _gather(
    world: World, point: NDArray, normal: NDArray, cells: NDArray, index: int, count: int
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Hits of ray `index` of `count` over each cell's hemisphere: surface, u, v, and albedo (0 for lights)."""
    shift = np.random.default_rng(7).random((2, len(cells)))
    a = ((index + 0.5) / count + shift[0]) % 1
    b = (index * 0.6180339887498949 + shift[1]) % 1
    radius, angle = np.sqrt(a), 2 * np.pi * b
    n = normal[:, cells]
    helper = np.where(np.abs(n[2]) > 0.9, np.array([[1.0], [0], [0]]), np.array([[0.0], [0], [1]]))
    tangent = cross(helper, n)
    tangent /= np.sqrt((tangent**2).sum(0))
    other = cross(n, tangent)
    direction = tangent * radius * np.cos(angle) + other * radius * np.sin(angle) + n * np.sqrt(1 - a)
    hits = world.trace(point[:, cells].astype(np.float32), direction.astype(np.float32))
    dark = world.shine[hits.surface] > 0  # direct light is already counted
    level = np.full(len(cells), 5, np.float32)
    albedo = world.atlas.sample(world.texture[hits.surface], hits.u, hits.v, level)
    return hits.surface, hits.u, hits.v, np.where(dark[:, None], 0, albedo)


def _filled(world: World, light: NDArray, buried: NDArray) -> NDArray:
    """Gives cells inside objects the mean of their neighbours, which avoids dark seams where objects touch."""
    light = light.copy()
    for surface in range(len(world.texture)):
        cells, shape = world.light_cells(surface)
        known = ~buried[cells].reshape(shape)
        values = light[cells].reshape(*shape, 3)
        while not known.all() and known.any():
            weight = _neighbours(known.astype(float)[..., None])
            mean = _neighbours(values * known[..., None]) / np.maximum(weight, 1)
            reached = ~known & (weight[..., 0] > 0)
            values = np.where(reached[..., None], mean, values)
            known = known | reached
        light[cells] = values.reshape(-1, 3)
    return light


def _smoothed(world: World, light: NDArray) -> NDArray:
    """Averages over 3 x 3 cells of each surface."""
    light = light.copy()
    for surface in range(len(world.texture)):
        cells, shape = world.light_cells(surface)
        values = light[cells].reshape(*shape, 3)
        light[cells] = (_neighbours(values) / _neighbours(np.ones((*shape, 1)))).reshape(-1, 3)
    return light


def _neighbours(values: NDArray) -> NDArray:
    """Sums over the 3 x 3 cells around each cell (h, w, C); beyond the border is 0."""
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
