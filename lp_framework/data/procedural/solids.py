"""Closed surfaces to build objects from: lofts, lathes, tubes, rounded boxes and bevelled extrusions, with texture
coordinates. +Y is up; a texture's left edge lies at the back (-Z) of a lathe, so its middle faces +Z."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from lp_framework.data.meshes import normalise
from lp_framework.data.procedural.paint import Colour, plain

Array = NDArray[np.float64]

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Shape:
    """Vertices `[V, 3]`, texture coordinates `[V, 2]` (origin at the bottom left), triangles `[F, 3]`."""

    vertices: Array
    uv: Array
    triangles: NDArray[np.int64]

    def move(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        """The shape shifted by `(x, y, z)`."""
        return Shape(self.vertices + np.array([x, y, z]), self.uv, self.triangles)

    def turn(self, axis: str, degrees: float) -> Shape:
        """The shape rotated about a coordinate axis, counter-clockwise seen from its tip."""
        rotation = trimesh.transformations.rotation_matrix(np.radians(degrees), AXES[axis])[:3, :3]
        return Shape(self.vertices @ rotation.T, self.uv, self.triangles)

    def scale(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Shape:
        """The shape stretched along the axes; a negative factor mirrors it."""
        triangles = self.triangles if x * y * z > 0 else self.triangles[:, ::-1]
        return Shape(self.vertices * np.array([x, y, z]), self.uv, triangles)

    def __add__(self, other: Shape) -> Shape:
        return Shape(
            np.concatenate([self.vertices, other.vertices]),
            np.concatenate([self.uv, other.uv]),
            np.concatenate([self.triangles, other.triangles + len(self.vertices)]),
        )

    def paint(self, texture: Image.Image | Colour, light: Array | None = None) -> trimesh.Trimesh:
        """The finished mesh: a matte material of one colour or with a texture, times a `light` of three colours."""
        texture = plain(texture) if isinstance(texture, tuple) else texture
        tint = None if light is None else [*light, 1.0]
        material = PBRMaterial(baseColorTexture=texture, baseColorFactor=tint, metallicFactor=0.0, roughnessFactor=1.0)
        visual = TextureVisuals(uv=self.uv, material=material)
        return trimesh.Trimesh(self.vertices, self.triangles, visual=visual, process=False)


def scene(*parts: trimesh.Trimesh) -> trimesh.Scene:
    """The normalised scene of the parts."""
    return normalise(trimesh.Scene(parts))


def curve(points: ArrayLike, count: int) -> Array:
    """`count` points `[count, D]` along a smooth (Catmull-Rom) curve through `points` `[P, D]`."""
    knots = np.asarray(points, dtype=np.float64)
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    position = np.linspace(0, len(knots) - 1, count)
    index = np.minimum(position.astype(int), len(knots) - 2)
    t = (position - index)[:, None]
    a, b, c, d = (padded[index + offset] for offset in range(4))
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)


def arc(centre: tuple[float, float], radius: float, start: float, stop: float, count: int = 9) -> Array:
    """Points `[count, 2]` on a circle, from angle `start` to `stop` (degrees, from the first axis)."""
    angle = np.radians(np.linspace(start, stop, count))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def arc_length(points: Array) -> Array:
    """Distance `[P]` from the first of the points `[P, D]` along their polyline, as a fraction of its length."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / max(steps.sum(), 1e-12)


def loft(rings: Array, closed: bool = False) -> Shape:
    """A surface over rings `[M, N, 3]`: `u` goes evenly around a ring, `v` by length along the middle.

    The ends are capped with fans; `closed` joins the last ring to the first instead. Triangles face outward.
    """
    rings = np.concatenate([rings, rings[:1]]) if closed else rings
    rings = np.concatenate([rings, rings[:, :1]], axis=1)  # the seam has two texture columns
    rows, columns = rings.shape[:2]
    steps = np.linalg.norm(np.diff(rings, axis=0), axis=2).mean(axis=1)
    v = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    u = np.linspace(0, 1, columns)
    vertices, uv = rings.reshape(-1, 3), np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    quads = corner + np.array([0, 1, columns + 1, columns])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    shape = Shape(vertices, uv, triangles)
    if closed:
        return outward(shape)
    for row, order in ((0, [0, 2, 1]), (rows - 1, [0, 1, 2])):
        ring = rings[row]
        centre = np.repeat(ring[:-1].mean(axis=0, keepdims=True), columns, axis=0)
        fan_uv = np.stack([u, np.full(columns, v[row])], axis=1)
        index = np.arange(columns - 1)[:, None]
        fan = np.concatenate([index + columns, index, index + 1], axis=1)[:, order]
        shape += Shape(np.concatenate([ring, centre]), np.concatenate([fan_uv, fan_uv]), fan)
    return outward(shape)


def outward(shape: Shape) -> Shape:
    """Orient the closed shape outward and remove triangles that collapse where a ring shrinks to a point."""
    a, b, c = np.moveaxis(shape.vertices[shape.triangles], 1, 0)
    kept = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12
    volume = np.einsum("fi,fi->", a, np.cross(b, c))
    triangles = shape.triangles[kept]
    return Shape(shape.vertices, shape.uv, triangles if volume > 0 else triangles[:, ::-1])


def lathe(profile: ArrayLike, segments: int = 64, closed: bool = False) -> Shape:
    """The surface that a profile `[M, 2]` of (radius, height) sweeps around +Y; `u` 0.5 faces +Z, going to +X."""
    radius, height = np.asarray(profile, dtype=np.float64).T
    angle = 2 * np.pi * (np.arange(segments) / segments - 0.5)
    ring = np.stack([np.sin(angle), np.zeros(segments), np.cos(angle)], axis=1)
    return loft(radius[:, None, None] * ring + height[:, None, None] * np.array([0.0, 1.0, 0.0]), closed)


def ellipsoid(x: float, y: float, z: float, segments: int = 40) -> Shape:
    """An ellipsoid with the given half axes; `v` runs from its bottom to its top."""
    return lathe(arc((0, 0), 1, -90, 90, segments // 2 + 1), segments).scale(x, y, z)


def cylinder(radius: float, height: float, bevel: float = 0.0, segments: int = 40) -> Shape:
    """An upright cylinder; `v` runs from the bottom's centre over the side to the top's centre."""
    half, inner = height / 2, radius - bevel
    profile = [(0, -half), (inner, -half), (radius, -half + bevel), (radius, half - bevel), (inner, half), (0, half)]
    return lathe(profile, segments)


def plan(x: float, z: float, radius: float, y: float, count: int = 96) -> Array:
    """A ring `[count, 3]` at height `y`: a rounded rectangle, from the middle of its back over -X.

    Its points are evenly spaced, so on a loft of such rings `u` is the length along the ring; 0.5 faces +Z.
    """
    corners = [(-x / 2, -z / 2), (-x / 2, z / 2), (x / 2, z / 2), (x / 2, -z / 2)]
    outline = np.concatenate([[(0.0, -z / 2)], rounded(corners, radius, 9), [(0.0, -z / 2)]])
    ring_x, ring_z = (np.interp(np.arange(count) / count, arc_length(outline), column) for column in outline.T)
    return np.stack([ring_x, np.full(count, y), ring_z], axis=1)


def tube(path: ArrayLike, radius: ArrayLike, segments: int = 16, closed: bool = False) -> Shape:
    """A round tube along points `[M, 3]`, with a single radius or one per point; `u` goes around, `v` along."""
    points = np.asarray(path, dtype=np.float64)
    tangents = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0) if closed else np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.eye(3)[np.abs(tangents[0]).argmin()]
    angle = 2 * np.pi * np.arange(segments) / segments
    rings = []
    for point, tangent, r in zip(points, tangents, np.broadcast_to(radius, len(points)), strict=True):
        side = side - tangent * (side @ tangent)  # transports the frame without twisting
        side /= np.linalg.norm(side)
        across = np.cross(tangent, side)
        rings.append(point + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * across))
    return loft(np.stack(rings), closed)


def rod(start: ArrayLike, stop: ArrayLike, radius: float, segments: int = 12) -> Shape:
    """A straight round bar between two points."""
    return tube(np.array([start, stop], dtype=np.float64), radius, segments)


def torus(major: float, minor: float, segments: int = 40) -> Shape:
    """A ring around +Y."""
    return lathe(arc((major, 0), minor, 0, 360, 17)[:-1], segments, closed=True)


BOX_FACES = {  # name: (right, up, out) as seen from outside, and the cell (column, row from the bottom) of the texture
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0), (1, 1)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1), (2, 1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0), (0, 0)),
    "top": ((1, 0, 0), (0, 0, -1), (0, 1, 0), (1, 0)),
    "bottom": ((1, 0, 0), (0, 0, 1), (0, -1, 0), (2, 0)),
}


def box(x: float, y: float, z: float, radius: float = 0.03, steps: int = 3) -> Shape:
    """A box of the given size with rounded edges; its texture has the six cells of `shapes.box_sheet`."""
    half = np.array([x, y, z]) / 2
    bulge = radius * np.tan(np.radians(np.linspace(0, 45, steps + 1)))
    shapes = []
    for right, up, out, cell in BOX_FACES.values():
        frame = np.array([right, up, out], dtype=np.float64)
        extent = np.abs(frame @ half)
        s, t = (np.concatenate([-(e - radius) - bulge[::-1], e - radius + bulge]) for e in extent[:2])
        grid = np.stack(np.meshgrid(s, t), axis=-1).reshape(-1, 2)
        surface = np.concatenate([grid, np.full((len(grid), 1), extent[2])], axis=1)
        core = np.clip(surface, radius - extent, extent - radius)
        arm = surface - core
        local = core + radius * arm / np.linalg.norm(arm, axis=1, keepdims=True)
        uv = (np.array(cell) + 0.5 + 0.499 * local[:, :2] / extent[:2]) / (3, 2)
        corner = (np.arange(len(t) - 1)[:, None] * len(s) + np.arange(len(s) - 1)).reshape(-1, 1)
        quads = corner + np.array([0, 1, len(s) + 1, len(s)])
        shapes.append(Shape(local @ frame, uv, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])))
    return joined(shapes)


def joined(shapes: Iterable[Shape]) -> Shape:
    """Several shapes as one, to share one texture."""
    return reduce(operator.add, shapes)


def extrude(outline: ArrayLike, depth: float, bevel: float = 0.02) -> Shape:
    """A counter-clockwise outline `[N, 2]` in XY thickened to `depth` along Z, with bevelled edges.

    Its texture has three cells: front, back (as seen from behind) and a strip for the rim,
    along which `u` follows the outline from its first point.
    """
    points = np.asarray(outline, dtype=np.float64)
    inset = points + bevel * inward(points)
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    levels = [(inset, -depth / 2), (points, bevel - depth / 2), (points, depth / 2 - bevel), (inset, depth / 2)]
    rings = [np.concatenate([ring, np.full((len(ring), 1), z)], axis=1) for ring, z in levels]
    count = len(points)
    here, there = np.arange(count), (np.arange(count) + 1) % count
    quads = np.stack([here, there, there + count, here + count], axis=1)

    def face(ring: Array, front: bool) -> Array:
        flat = (ring[:, :2] - low) / size
        across = flat[:, 0] if front else 2 - flat[:, 0]
        return np.stack([across / 2, 0.25 + 0.75 * flat[:, 1]], axis=1)

    shapes = []
    cap = ears(inset)
    for front, outer, inner in ((False, rings[1], rings[0]), (True, rings[2], rings[3])):
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], cap + count])
        vertices = np.concatenate([outer, inner])
        shapes.append(Shape(vertices, face(vertices, front), triangles if front else triangles[:, ::-1]))
    # The rim has a quad for each edge, so that the ends of the strip stay separate.
    corners = np.stack([rings[1], rings[1][there], rings[2][there], rings[2]], axis=1)
    length = arc_length(np.concatenate([points, points[:1]]))
    u = np.stack([length[:-1], length[1:], length[1:], length[:-1]], axis=1).ravel()
    uv = np.stack([u, np.tile([0.02, 0.02, 0.22, 0.22], count)], axis=1)
    triangles = (4 * here[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    return joined([*shapes, Shape(corners.reshape(-1, 3), uv, triangles)])


def inward(points: Array) -> Array:
    """Mitre vectors `[N, 2]` that move every edge of a counter-clockwise polygon `[N, 2]` inward by 1."""
    edge = np.roll(points, -1, axis=0) - points
    normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(normal, 1, axis=0)
    return (normal + before) / (1 + (normal * before).sum(axis=1, keepdims=True))


def ears(points: Array) -> NDArray[np.int64]:
    """Triangles `[N - 2, 3]` of a simple counter-clockwise polygon `[N, 2]`, by ear clipping."""

    def turn(a: Array, b: Array, c: Array) -> Array:
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    left = list(range(len(points)))
    triangles = []
    while len(left) > 2:
        for k in range(len(left)):
            i, j, m = left[k - 1], left[k], left[(k + 1) % len(left)]
            a, b, c = points[i], points[j], points[m]
            others = points[[q for q in left if q not in (i, j, m)]]
            inside = (turn(a, b, others) >= 0) & (turn(b, c, others) >= 0) & (turn(c, a, others) >= 0)
            if turn(a, b, c) > 0 and not inside.any():
                triangles.append((i, j, m))
                left.pop(k)
                break
        else:
            raise ValueError("the outline crosses itself or is not counter-clockwise")
    return np.array(triangles, dtype=np.int64)


def rounded(corners: ArrayLike, radius: float, steps: int = 5) -> Array:
    """A counter-clockwise polygon `[N, 2]` with its corners rounded (quadratic curves that start `radius` away)."""
    points = np.asarray(corners, dtype=np.float64)
    t = np.linspace(0, 1, steps)[:, None]
    pieces = []
    for before, here, after in zip(np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0), strict=True):
        a = here + (before - here) * min(radius / np.linalg.norm(before - here), 0.49)
        b = here + (after - here) * min(radius / np.linalg.norm(after - here), 0.49)
        pieces.append((1 - t) ** 2 * a + 2 * t * (1 - t) * here + t**2 * b)
    return np.concatenate(pieces)


def wheel(radius: float, width: float) -> Shape:
    """A wheel with its axle along Z, for `paint.wheel_paint`."""
    return cylinder(radius, width, 0.12 * radius).turn("x", 90)


def both(shape: Shape) -> Shape:
    """The shape and a copy rotated by half a turn."""
    return shape + shape.turn("y", 180)


def hollow(outside: Array, wall: float) -> tuple[Array, float]:
    """The profile of a vessel closed at the bottom, from its outer profile, and the outer fraction of its length."""
    inside = (outside - (wall, 0))[::-1]
    inside = inside[inside[:, 1] > outside[0, 1] + 3 * wall]
    profile = np.concatenate([[(0, outside[0, 1])], outside, inside, [(0, inside[-1, 1])]])
    return profile, float(arc_length(profile)[len(outside)])
