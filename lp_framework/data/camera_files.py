"""Cameras for other programs: nerfstudio, instant-ngp and iFusion (`transforms.json`), COLMAP, gsplat and 3D Gaussian
Splatting (`sparse/0`), Blender and web viewers (GLB).

All files use our world coordinates, with +Y up. Pixels are square, and the principal point is the image centre.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from lp_framework.atomic import written
from lp_framework.data.masks import HALF
from lp_framework.data.outlines import convex_outline, match_outlines
from lp_framework.data.photographs import EXTENT, SIZE, Box, Photograph, Prepared, exif_focal, on_white, save_upright
from lp_framework.geometry import camera_to_world, from_opencv, inverse, level_camera, to_ifusion

CELLS = 64  # voxels across the ball from which the visual hull is carved
REACH = 1.2  # its radius, relative to half the width that the reference sees at the object's distance
FEWEST = 100  # points of a hull; fewer mean that the masks are inconsistent
NEAR = 0.2  # distance of a drawn image from its camera, as a fraction of the camera's from the origin
ASSUMED, ASSUMED_FOCAL = "assumed", 1.2  # times the longer side of a photograph, as in COLMAP
ORIGINAL = "original"  # folder of the original photographs


class Camera(NamedTuple):
    """The camera of an image: the image's file, camera to world `[4, 4]` (OpenGL axes); focal length, width and height
    in pixels."""

    file: str
    matrix: NDArray[np.float64]
    focal: float
    width: int
    height: int

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points `[..., 3]` to pixels `[..., 2]` (column, row); the first pixel's centre is (0.5, 0.5). Points
        behind the camera land far outside the image."""
        x, y, z = np.moveaxis((points - self.matrix[:3, 3]) @ self.matrix[:3, :3], -1, 0)
        scale = self.focal / np.maximum(-z, 1e-9)
        return np.stack([self.width / 2 + scale * x, self.height / 2 - scale * y], axis=-1)


def focal_length(size: int, field_of_view_degrees: float) -> float:
    """The focal length in pixels of an image of `size` pixels a side."""
    return size / 2 / math.tan(math.radians(field_of_view_degrees) / 2)


def view_cameras(files: Sequence[str], poses: Tensor, size: int, field_of_view_degrees: float) -> list[Camera]:
    """The cameras of square views with view poses `[V, 3]`."""
    focal, matrices = focal_length(size, field_of_view_degrees), camera_to_world(poses.double()).numpy()
    return [Camera(file, matrix, focal, size, size) for file, matrix in zip(files, matrices, strict=True)]


def photograph_camera(
    file: str, pose: Tensor, size: tuple[int, int], box: Box | None, focal: float, field_of_view_degrees: float
) -> Camera:
    """The camera of a photograph of `size` (width, height) and focal length `focal` (pixels), whose crop to the
    object's bounding box `box` is a view with this pose `[3]` and field of view; without a box it is the view itself.

    The view's camera looks at the object's centre; the photograph's is level and in the same direction from the centre.
    The object is approximated by a ball as wide as the box's longer side, as in the view: the planes through the camera
    and two edges of the box touch the ball, so its centre lies midway between them, and the angle between them gives
    its distance.
    """
    if box is None:
        return Camera(file, camera_to_world(pose.double()).numpy(), focal, *size)
    edges = np.arctan((np.reshape(box, (2, 2)) - np.array(size) / 2) / focal)  # angles: left and top; right and bottom
    middle, half = edges.mean(axis=0), np.diff(edges, axis=0)[0] / 2  # across, down
    longer = 0 if box[2] - box[0] > box[3] - box[1] else 1
    ball = pose[2].item() * math.sin(math.atan(EXTENT / 2 / focal_length(SIZE, field_of_view_degrees)))  # its radius
    depth = ball * math.cos(middle[longer]) / math.sin(half[longer])
    direction = torch.tensor([math.tan(middle[0]), -math.tan(middle[1]), -1.0], dtype=torch.float64)
    place = torch.cat([pose[:2].double(), depth * direction.norm(keepdim=True)])
    return Camera(file, level_camera(place, direction).numpy(), focal, *size)


def nerf_transforms(cameras: Sequence[Camera], poses: Tensor | None = None) -> dict[str, Any]:
    """The contents of a `transforms.json`. Intrinsics that differ between cameras are written per frame. With the
    cameras' view poses `[V, 3]`, each frame has iFusion's `latlon`: *down*-positive latitude and longitude in degrees,
    radius."""
    intrinsics = [
        {"camera_angle_x": 2 * math.atan(width / 2 / focal), "fl_x": focal, "fl_y": focal,
         "cx": width / 2, "cy": height / 2, "w": width, "h": height}
        for _, _, focal, width, height in cameras
    ]  # fmt: skip
    shared = intrinsics[0] if all(each == intrinsics[0] for each in intrinsics) else {}
    latlons = [{}] * len(cameras) if poses is None else [{"latlon": each} for each in to_ifusion(poses).tolist()]
    frames = [
        {"file_path": camera.file, "transform_matrix": camera.matrix.tolist(), **({} if shared else own), **latlon}
        for camera, own, latlon in zip(cameras, intrinsics, latlons, strict=True)
    ]
    return {**shared, "frames": frames}


def colmap_model(cameras: Sequence[Camera], points: trimesh.PointCloud) -> dict[str, str]:
    """A COLMAP sparse model as text (https://colmap.github.io/format.html): file name to contents.

    PINHOLE cameras; images (world to camera: a quaternion, scalar first, and a translation; COLMAP's axes, x right, y
    down, z forward); points, without the images that observe them.
    """
    kinds = list(dict.fromkeys(camera[2:] for camera in cameras))
    matrices = torch.from_numpy(np.stack([camera.matrix for camera in cameras]))
    matrices = inverse(from_opencv(matrices))  # the change of axes is its own inverse
    quaternions = Rotation.from_matrix(matrices[:, :3, :3].numpy()).as_quat(canonical=True)  # scalar last
    pinholes = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, (focal, width, height) in enumerate(kinds, start=1):
        pinholes.append(f"{number} PINHOLE {width} {height} {focal:.12g} {focal:.12g} {width / 2:g} {height / 2:g}")
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, (camera, (x, y, z, w), matrix) in enumerate(zip(cameras, quaternions, matrices, strict=True), start=1):
        values = " ".join(f"{round(value, 12) + 0.0:.12g}" for value in (w, x, y, z, *matrix[:3, 3].tolist()))
        kind, name = kinds.index(camera[2:]) + 1, Path(camera.file).name
        lines += [
            f"{number} {values} {kind} {name}",
            "",
        ]  # the second line lists image points; there are none
    seeds = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, ((x, y, z), (r, g, b, _)) in enumerate(zip(points.vertices, points.colors, strict=True), start=1):
        seeds.append(f"{number} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} -1")  # -1: unknown error
    contents = {"cameras.txt": pinholes, "images.txt": lines, "points3D.txt": seeds}
    return {name: "\n".join(content) + "\n" for name, content in contents.items()}


class Crop(NamedTuple):
    """Where a prepared image lies in a camera's image: its middle, and how many pixels wide one of its pixels is."""

    middle: NDArray[np.float64]
    scale: float

    @classmethod
    def to(cls, box: Box | None, size: tuple[int, int]) -> Crop:
        """The crop of an image of `size` (width, height) to an object's bounding box; without a box, all of it."""
        if box is None:
            return cls(np.array(size) / 2, size[0] / SIZE)
        left, top, right, bottom = box
        return cls(np.array([left + right, top + bottom]) / 2, max(right - left, bottom - top) / EXTENT)


def seed_points(cameras: Sequence[Camera], images: Sequence[Image.Image], crops: Sequence[Crop]) -> trimesh.PointCloud:
    """Points to initialize a reconstruction: the surface of the visual hull, carved by the opacity of RGBA images, the
    `crops` of what the cameras see, from a ball around the origin; the whole ball if almost nothing remains. A point
    has its colour in the nearest camera's image."""
    centres = np.stack([camera.matrix[:3, 3] for camera in cameras])
    half = images[0].width / 2 * crops[0].scale  # pixels
    reach = REACH * float(np.linalg.norm(centres[0])) * half / cameras[0].focal
    steps = reach * ((np.arange(CELLS) + 0.5) * 2 / CELLS - 1)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    ball = np.linalg.norm(points, axis=1) < reach
    hull, colours = ball, []
    for camera, image, crop in zip(cameras, images, crops, strict=True):
        size = np.array(image.size)
        pixels = (camera.pixels(points) - crop.middle) / crop.scale + size / 2
        column, row = pixels.clip(0, size - 1).astype(int).T  # outside: the edge's value
        hull = hull & (np.asarray(image)[row, column, 3] >= HALF)
        colours.append(on_white(image)[row, column])
    solid = hull.reshape(CELLS, CELLS, CELLS)
    surface = (solid & ~binary_erosion(solid)).ravel()
    kept = np.flatnonzero(surface if surface.sum() >= FEWEST else ball)
    _, nearest = KDTree(centres).query(points[kept])
    return trimesh.PointCloud(points[kept], np.stack(colours)[nearest, kept])


def camera_scene(cameras: Sequence[Camera], images: Sequence[Image.Image], names: Sequence[str]) -> trimesh.Scene:
    """The cameras as small frusta showing their RGBA images; node NAME is an image, `NAME frustum` its frustum."""
    scene = trimesh.Scene()
    for (_, matrix, focal, width, height), image, name in zip(cameras, images, names, strict=True):
        distance = float(np.linalg.norm(matrix[:3, 3]))
        sides = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # also the texture coordinates
        corners = np.c_[sides * [width / 2 / focal, height / 2 / focal], -np.ones(4)] * NEAR * distance
        corners = trimesh.transform_points(corners, matrix)
        ends = [*((matrix[:3, 3], each) for each in corners), *zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        edges = [trimesh.creation.cylinder(distance / 500, segment=end, sections=6) for end in ends]
        scene.add_geometry(trimesh.util.concatenate(edges), f"{name} frustum", f"{name} frustum")
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0, alphaMode="MASK", doubleSided=True
        )
        visual = trimesh.visual.TextureVisuals(uv=(sides + 1) / 2, material=material)
        scene.add_geometry(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False), name, name)
    return scene


def write_cameras(
    folder: Path, cameras: Sequence[Camera], points: trimesh.PointCloud, poses: Tensor | None = None
) -> None:
    """Write `transforms.json` (see `nerf_transforms`) with nerfstudio's `sparse_pc.ply`, and the COLMAP model as
    `sparse/0`, for images in `folder/images`."""
    (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    transforms = nerf_transforms(cameras, poses) | {"ply_file_path": "sparse_pc.ply"}
    files = {
        "transforms.json": json.dumps(transforms, indent=2).encode(),
        "sparse_pc.ply": points.export(file_type="ply"),
    }
    files |= {f"sparse/0/{name}": text.encode() for name, text in colmap_model(cameras, points).items()}
    for name, content in files.items():
        with written(folder / name) as partial:
            partial.write_bytes(content)


def original_focal_length(
    photograph: Photograph, prepared: Prepared, field_of_view_degrees: float
) -> tuple[float, str]:
    """The focal length of a photograph in pixels and its source: EXIF, the field of view if the photograph is a view,
    or an assumption."""
    size = photograph.image.size
    if prepared.box is None:
        return focal_length(size[0], field_of_view_degrees), "field of view"
    told = exif_focal(photograph.image)
    return (ASSUMED_FOCAL * max(size), ASSUMED) if told is None else (told, "EXIF")


def match_cameras(cameras: Sequence[Camera], images: Sequence[Image.Image], crops: Sequence[Crop]) -> list[Camera]:
    """Move cameras until the object's outlines in crops of their images match, see `match_outlines`."""
    rays = []
    for camera, image, crop in zip(cameras, images, crops, strict=True):
        pixels = (convex_outline(np.asarray(image)[..., 3] >= HALF) - SIZE / 2) * crop.scale + crop.middle
        across, down = ((pixels - [camera.width / 2, camera.height / 2]) / camera.focal).T
        rays.append(np.stack([across, -down, -np.ones(len(pixels))], axis=-1))
    matrices = match_outlines(np.stack([camera.matrix for camera in cameras]), np.stack(rays))
    return [camera._replace(matrix=matrix) for camera, matrix in zip(cameras, matrices, strict=True)]


def export_cameras(
    folder: Path, photographs: Mapping[int, tuple[Photograph, Prepared]], poses: Tensor, field_of_view_degrees: float
) -> None:
    """Write the cameras of numbered photographs with view poses `[V, 3]`: for the prepared images in `folder/images`,
    for copies of the photographs in `folder/original`, and as `cameras.glb`. The cameras of crops are moved until the
    object's outlines match."""
    files = {number: Path(photograph.name) for number, (photograph, _) in photographs.items()}
    images = [prepared.image for _, prepared in photographs.values()]
    views = view_cameras([f"images/{number:03d}.png" for number in files], poses, SIZE, field_of_view_degrees)
    originals, crops = [], []
    (folder / ORIGINAL / "images").mkdir(parents=True, exist_ok=True)
    for (number, (photograph, prepared)), pose in zip(photographs.items(), poses, strict=True):
        copy = f"images/{number:03d}{files[number].suffix.lower()}"
        save_upright(files[number], folder / ORIGINAL / copy)
        focal, _ = original_focal_length(photograph, prepared, field_of_view_degrees)
        size = photograph.image.size
        originals.append(photograph_camera(copy, pose, size, prepared.box, focal, field_of_view_degrees))
        crops.append(Crop.to(prepared.box, size))
    whole = [Crop.to(None, image.size) for image in images]
    if all(prepared.box is not None for _, prepared in photographs.values()):
        views, originals = match_cameras(views, images, whole), match_cameras(originals, images, crops)
    write_cameras(folder, views, seed_points(views, images, whole), poses)
    write_cameras(folder / ORIGINAL, originals, seed_points(originals, images, crops))
    scene = camera_scene(views, images, [f"{number} {file.name}" for number, file in files.items()])
    with written(folder / "cameras.glb") as partial:
        partial.write_bytes(scene.export(file_type="glb"))
