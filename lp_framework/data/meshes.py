"""Meshes: loading and normalising files, and the surfaces that the renderers draw.

A normalised scene has a bounding box centred at the origin with a longest side of 1 (the paper, Dataset Construction).
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import coo_array
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from lp_framework.data.files import Origin, expecting
from lp_framework.data.images import eight_bit
from lp_framework.data.mesh_files import read_mesh
from lp_framework.data.mesh_files.common import (
    FARTHEST,
    LINEAR_COLOUR,
    MIRROR,
    REPEAT,
    WRAP,
    MissingColourWarning,
    warn,
)
from lp_framework.errors import UserError

Ambiguity = Literal["unique", "twofold", "continuous", "unlabelled"]

NEUTRAL_GREY = 0.6  # linear reflectance of parts without texture or colour
CREASE_ANGLE = np.radians(40)  # edges that bend less are shaded smoothly
LARGEST_TEXTURE = 2048  # pixels per side, finer than the views can show
UP_AXES = {".glb": "y", ".gltf": "y", ".3mf": "z"}  # of formats with a standardized up axis


@dataclass(frozen=True)
class MeshObject:
    """One object of a data source: its name, its ambiguity class, and a function that loads its normalised scene.

    `load` is sent to worker processes: a module-level function or a `functools.partial` of one. `unique_answer` says
    whether a view has one correct longitude: by default, asymmetric shapes and two-fold ones, resolved by their
    texture, have one; bodies of revolution need a texture that resolves it; None is unknown. `origin` has the source
    files, if available.
    """

    name: str
    ambiguity: Ambiguity
    load: Callable[[], trimesh.Scene]
    unique_answer: bool | None = None
    origin: Origin | None = None

    def __post_init__(self) -> None:
        if self.unique_answer is None and self.ambiguity != "unlabelled":
            object.__setattr__(self, "unique_answer", self.ambiguity in ("unique", "twofold"))


@dataclass(frozen=True)
class Surface:
    """T triangles of one material in the scene's frame; corner `3 i + j` is the j-th of triangle i; none is shared.

    Colours multiply: the texture (sRGB, decoded by the renderers), `colour` and `corner_colours` (both linear).
    """

    positions: NDArray[np.float32]  # [3T, 3]
    normals: NDArray[np.float32]  # [3T, 3], unit, towards the side from which corners run counter-clockwise
    twins: NDArray[np.int64]  # [T], index (over all surfaces) of the triangle that backs this one, or -1
    colour: NDArray[np.float32]  # [3]
    corner_colours: NDArray[np.float32] | None  # [3T, 3]
    texture: NDArray[np.uint8] | None = None  # [h, w, 3], sides are powers of two, first row at the top
    texture_coordinates: NDArray[np.float32] | None = None  # [3T, 2], v upwards
    wrap: NDArray[np.int64] | None = None  # [2], wrap mode across and up (OpenGL's constants); None: repeat


def load_scene(path: Path, up: Literal["y", "z"] = "y", folders: Sequence[Path] = ()) -> trimesh.Scene:
    """Load the normalised scene of a mesh file (glb, obj, ply, stl, off, ...), whose axis `up` becomes our +Y.

    Textures and materials are searched for beside it and in `folders`. Warns of anything not drawn as in the file and
    of parts without colour. Raises `UserError` naming the file if it is missing, does not load, needs unsupported
    features, or has no faces or no extent.
    """
    if not path.is_file():
        raise UserError(f"{path}: there is no such mesh file")
    with expecting(f"{path}: does not load as a mesh"), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # from large textures
        scene = read_mesh(path, (path.parent, *folders))
        if up == "z":
            scene.apply_transform(np.eye(4)[[1, 2, 0, 3]])  # same as `real_cameras.z_up_to_y_up`
        scene = normalise(scene)
    axis = UP_AXES.get(path.suffix.lower(), up)
    if axis != up:
        warn(path, f"files of this format have +{axis.upper()} up, but data.up={up} is set")
    if plain := sum(not _has_colour(mesh) for mesh in scene.geometry.values()):
        grey = f"{plain} of {len(scene.geometry)} meshes have no texture or colour; they are drawn in light grey"
        warn(path, grey, MissingColourWarning)
    if any(_image(mesh) is not None and _encoded_colours(mesh) is not None for mesh in scene.geometry.values()):
        warn(path, "has vertex or face colours beside its texture; the texture is drawn")
    return scene


def normalise(scene: trimesh.Scene) -> trimesh.Scene:
    """A copy with the bounding box centred at the origin and its longest side 1, all transforms applied, without points
    and paths. Raises `ValueError` if no faces, no extent or no area remain."""
    meshes = _meshes(scene)
    if not meshes:
        raise ValueError("it has no faces")
    bounds = np.array([mesh.bounds for mesh in meshes])
    lowest, highest = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    side = (highest - lowest).max()
    if not (np.isfinite(side) and side > 0):
        raise ValueError(f"it has no valid extent: the longest side of its bounding box is {side}")
    if not any(mesh.area > 0 for mesh in meshes):
        raise ValueError("all of its faces have area 0")
    for mesh in meshes:
        mesh.vertices = (mesh.vertices - (lowest + highest) / 2) / side
    return trimesh.Scene(meshes)


def _meshes(scene: trimesh.Scene) -> list[trimesh.Trimesh]:
    return [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]


def fingerprint(scene: trimesh.Scene) -> str:
    """A hash of everything in a scene that affects its rendering."""
    digest = hashlib.sha256()
    for surface in surfaces(scene):
        for array in vars(surface).values():
            if array is not None:
                digest.update(str(array.shape).encode())
                digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


def surfaces(scene: trimesh.Scene) -> list[Surface]:
    """Convert a scene to surfaces, one `Surface` per mesh.

    Normals are computed from the shape alone and ignore those of the file: they are smooth across edges, including
    texture seams, that bend less than `CREASE_ANGLE`. Metalness, normal maps and transparency are ignored. Of
    coinciding triangles that face the same way only the first is kept, because which one is visible would be arbitrary.
    """
    meshes = _meshes(scene)
    mesh_of_triangle = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    face_of_triangle = np.concatenate([np.arange(len(mesh.faces)) for mesh in meshes])
    points = _weld(np.concatenate([mesh.triangles for mesh in meshes]).reshape(-1, 3)).reshape(-1, 3)
    degenerate = (points == np.roll(points, 1, axis=1)).any(axis=1)
    # Rotate each to start at its lowest index, keeping the order.
    points = points[np.arange(len(points))[:, None], (points.argmin(axis=1)[:, None] + np.arange(3)) % 3]
    kept = np.sort(np.unique(points, axis=0, return_index=True)[1])
    kept = kept[~degenerate[kept]]
    twins = _twins(points[kept])
    parts = ((mesh, mesh_of_triangle[kept] == index) for index, mesh in enumerate(meshes))
    return [_surface(mesh, face_of_triangle[kept[own]], twins[own]) for mesh, own in parts if own.any()]


def _surface(mesh: trimesh.Trimesh, faces: NDArray[np.int64], twins: NDArray[np.int64]) -> Surface:
    corners = mesh.faces[faces].reshape(-1)
    positions, normals = mesh.vertices[corners].astype(np.float32), _corner_normals(mesh.triangles[faces])
    image, colour = _image(mesh), _factor(mesh)
    if colour is None:
        colour = np.full(3, 1.0 if _has_colour(mesh) else NEUTRAL_GREY)
    painted = Surface(positions, normals, twins, colour.astype(np.float32), _corner_colours(mesh, faces))
    if image is None:
        return painted
    coordinates, wrap = _mapping(mesh, corners)
    return replace(painted, texture=_texture(image), texture_coordinates=coordinates, wrap=wrap)


def _mapping(mesh: trimesh.Trimesh, corners: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64] | None]:
    """The texture coordinates `[3T, 2]` of corners and how the texture wraps.

    They are 0 in triangles with an invalid coordinate, which the renderers would draw differently.
    """
    coordinates = np.asarray(mesh.visual.uv, np.float32)[corners]  # type: ignore
    proper = (np.abs(coordinates) < FARTHEST).reshape(-1, 6).all(axis=1)
    coordinates = np.where(np.repeat(proper, 3)[:, None], coordinates, np.float32(0))
    wrap = np.array(mesh.metadata.get(WRAP, (REPEAT, REPEAT)))
    for axis in np.flatnonzero(wrap == MIRROR):
        lowest, highest = coordinates[:, axis].min(), coordinates[:, axis].max()
        period = np.floor(lowest)
        if highest <= period + 1:  # not mirrored on this surface
            inside = coordinates[:, axis] - period
            coordinates[:, axis] = 1 - inside if period % 2 else inside
            wrap[axis] = REPEAT
    return coordinates, None if (wrap == REPEAT).all() else wrap


def _weld(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices `[n]` of the points `[n, 3]`, equal for coinciding points."""
    scale = 1e-6 * max(float(np.ptp(points, axis=0).max()), np.finfo(float).tiny)
    return np.unique(np.round(points / scale).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)


def _twins(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each of distinct triangles `[T, 3]`, the index of the one with the same points in reverse order, or -1."""
    turned = triangles[:, [0, 2, 1]]
    group = np.unique(np.concatenate([triangles, turned]), axis=0, return_inverse=True)[1].reshape(-1)
    owner = np.full(group.max() + 1, -1)
    owner[group[: len(triangles)]] = np.arange(len(triangles))
    return owner[group[len(triangles) :]]


def _corner_normals(triangles: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals `[3T, 3]` of the corners of `[T, 3, 3]`: the area-weighted mean over the adjacent faces whose
    normals lie within the crease angle of the corner's face."""
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])  # 2 area * unit normal
    units = trimesh.util.unitize(areas)
    points = _weld(triangles.reshape(-1, 3))
    face_of_corner = np.repeat(np.arange(len(triangles)), 3)
    incidence = coo_array((np.ones(len(points), np.int8), (np.arange(len(points)), points))).tocsr()
    corner, other = (incidence @ incidence.T).nonzero()  # all pairs of corners that share a point
    near = (units[face_of_corner[corner]] * units[face_of_corner[other]]).sum(axis=1) > np.cos(CREASE_ANGLE)
    corner, weighted = corner[near], areas[face_of_corner[other[near]]]
    normals = np.stack([np.bincount(corner, weighted[:, axis], len(points)) for axis in range(3)], axis=1)
    return trimesh.util.unitize(normals).astype(np.float32)


def _has_colour(mesh: trimesh.Trimesh) -> bool:
    coloured = LINEAR_COLOUR in mesh.vertex_attributes or _encoded_colours(mesh) is not None
    return coloured or _image(mesh) is not None or _factor(mesh) is not None


def _image(mesh: trimesh.Trimesh) -> Image.Image | None:
    """The image that colours the mesh, if the mesh also has texture coordinates."""
    if not isinstance(mesh.visual, TextureVisuals) or mesh.visual.uv is None:
        return None
    match mesh.visual.material:
        case PBRMaterial(baseColorTexture=image) | SimpleMaterial(image=image):
            return image
    return None


def _factor(mesh: trimesh.Trimesh) -> NDArray[np.floating] | None:
    """The linear colour `[3]` of the material, if the file gives one and does not colour the vertices."""
    match mesh.visual.material if isinstance(mesh.visual, TextureVisuals) else None:
        case PBRMaterial(baseColorFactor=factor) if factor is not None:
            return np.asarray(factor, float)[:3] / 255  # glTF: linear
        case SimpleMaterial(image=None, diffuse=diffuse, kwargs=properties) if _encoded_colours(mesh) is None and (
            "kd" in properties or not np.array_equal(diffuse, SimpleMaterial().diffuse)
        ):
            return srgb_to_linear(np.asarray(diffuse, float)[:3] / 255)
    return None


def _encoded_colours(mesh: trimesh.Trimesh) -> tuple[str, NDArray[np.uint8]] | None:
    """Which elements the file colours, "vertex" or "face", and the colours `[V or F, 3 or 4]` in sRGB."""
    if isinstance(mesh.visual, ColorVisuals):
        kind = mesh.visual.kind
        return None if kind is None else (kind, getattr(mesh.visual, f"{kind}_colors"))
    for kind, attributes in (("vertex", mesh.vertex_attributes), ("face", mesh.face_attributes)):
        if "color" in attributes:  # where trimesh keeps them beside a material
            return kind, np.asarray(attributes["color"])
    return None


def _corner_colours(mesh: trimesh.Trimesh, faces: NDArray[np.int64]) -> NDArray[np.float32] | None:
    """Linear colours `[3T, 3]` from vertex or face colours, which formats other than glTF store in sRGB; in these, a
    texture overrides them."""
    corners = mesh.faces[faces].reshape(-1)
    if LINEAR_COLOUR in mesh.vertex_attributes:
        linear = np.asarray(mesh.vertex_attributes[LINEAR_COLOUR], np.float32)
        return np.nan_to_num(linear[corners, :3]).clip(0, 1)
    encoded = _encoded_colours(mesh)
    if encoded is None or _image(mesh) is not None:
        return None
    kind, levels = encoded
    colours = levels[corners] if kind == "vertex" else np.repeat(levels[faces], 3, axis=0)
    return srgb_to_linear(colours[:, :3] / 255).astype(np.float32)


def _texture(image: Image.Image) -> NDArray[np.uint8]:
    """Convert the image to RGB with power-of-two sides, so that mip levels halve exactly in every renderer."""
    size = tuple(min(LARGEST_TEXTURE, 2 ** round(np.log2(side))) for side in image.size)
    colour = eight_bit(image).convert("RGB")
    return np.asarray(colour if colour.size == size else colour.resize(size, Image.Resampling.LANCZOS))


def srgb_to_linear(encoded: NDArray[np.floating]) -> NDArray[np.floating]:
    """Convert sRGB values in [0, 1] to linear light (IEC 61966-2-1).

    >>> srgb_to_linear(np.array([0.0, 0.5, 1.0])).round(4).tolist()
    [0.0, 0.214, 1.0]
    """
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
