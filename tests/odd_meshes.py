"""Mesh files that are easily misread, each with a plain one that must look the same.

All show a square in the plane z = 0, one unit wide, with a picture of four colours: red, green in the upper row, blue,
yellow in the lower one.
"""

from __future__ import annotations

import base64
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

CORNERS = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v points down, as in glTF
COMPONENT_TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
CLAMP, MIRROR = 33071, 33648


def picture() -> Image.Image:
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[:8, :8], pixels[:8, 8:] = (220, 30, 30), (30, 200, 30)
    pixels[8:, :8], pixels[8:, 8:] = (30, 30, 220), (220, 220, 30)
    return Image.fromarray(pixels)


def encoded(image: Image.Image, kind: str = "PNG") -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **({"lossless": True} if kind == "WEBP" else {}))
    return file.getvalue()


class Gltf:
    """A glTF file with the square, to be changed and written."""

    def __init__(
        self,
        corners: NDArray[Any] = CORNERS,
        uv: NDArray[Any] | None = UV,
        normalized: bool = False,
        image: bytes | None = encoded(picture()),
    ) -> None:
        self.blob = bytearray()
        self.header: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        self.attributes = {"POSITION": self.accessor(corners, normalized and corners.dtype != np.float32)}
        self.primitive = {"attributes": self.attributes, "indices": self.accessor(FACES), "material": 0}
        self.node: dict[str, Any] = {"mesh": 0}
        self.header |= {"meshes": [{"primitives": [self.primitive]}], "nodes": [self.node], "scenes": [{"nodes": [0]}]}
        self.material: dict[str, Any] = {"pbrMetallicRoughness": {}}
        self.header["materials"] = [self.material]
        if uv is not None:
            self.attributes["TEXCOORD_0"] = self.accessor(uv, normalized and uv.dtype != np.float32)
        if image is not None:
            self.header["images"] = [{"bufferView": self.view(image), "mimeType": "image/png"}]
            self.header["textures"] = [{"source": 0}]
            self.material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}

    @property
    def texture(self) -> dict[str, Any]:
        return self.material["pbrMetallicRoughness"]["baseColorTexture"]

    def view(self, data: bytes, **more: Any) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.header["bufferViews"].append({"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data), **more})
        self.blob += data
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values: NDArray[Any], normalized: bool = False, view: int | None = None, **more: Any) -> int:
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[1 if values.ndim == 1 else values.shape[1]]
        place = self.view(values.tobytes()) if view is None else view
        described = {"bufferView": place, "componentType": COMPONENT_TYPES[values.dtype.name], "count": len(values)}
        described |= {"type": kind, **({"normalized": True} if normalized else {}), **more}
        self.header["accessors"].append(described)
        return len(self.header["accessors"]) - 1

    def write(self, folder: Path, suffix: str = "glb") -> Path:
        folder.mkdir(exist_ok=True)
        path = folder / f"odd.{suffix}"
        self.header.setdefault("buffers", [{"byteLength": len(self.blob)}])
        if suffix == "gltf":
            data = base64.b64encode(self.blob).decode()
            self.header["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
            path.write_text(json.dumps(self.header))
            return path
        text = json.dumps(self.header).encode()
        chunks = [
            (b"JSON", text + b" " * (-len(text) % 4)),
            (b"BIN\0", bytes(self.blob) + b"\0" * (-len(self.blob) % 4)),
        ]
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
        return path


Writer = Callable[[Path], Path]  # writes a file into a folder
ODD: dict[str, Writer] = {}  # what looks like the plain square
OTHER: dict[str, Writer] = {}  # what does not


def odd(write: Writer) -> Writer:
    ODD[write.__name__] = write
    return write


def other(write: Writer) -> Writer:
    OTHER[write.__name__] = write
    return write


@odd
def plain(folder: Path) -> Path:
    return Gltf().write(folder)


def scaled(kind: type, corners: ArrayLike) -> NDArray[Any]:
    return np.rint(np.asarray(corners) * np.iinfo(kind).max).astype(kind)


@odd
def normalized_shorts(folder: Path) -> Path:
    file = Gltf(scaled(np.int16, CORNERS * 2), scaled(np.uint16, UV), normalized=True)
    file.node["scale"] = [0.5, 0.5, 0.5]
    file.header["extensionsRequired"] = ["KHR_mesh_quantization"]
    return file.write(folder)


@odd
def normalized_bytes(folder: Path) -> Path:
    corners = np.pad(scaled(np.int8, CORNERS * 2), ((0, 0), (0, 1)))  # rows of 4 bytes
    file = Gltf(uv=scaled(np.uint8, UV), normalized=True)
    view = file.view(corners.tobytes(), byteStride=4)
    file.attributes["POSITION"] = file.accessor(corners[:, :3], normalized=True, view=view)
    return file.write(folder)


@odd
def quantized_by_a_transform(folder: Path) -> Path:
    file = Gltf(((CORNERS + 0.5) * 1000).astype(np.uint16), (UV * 4000).astype(np.uint16))
    file.node |= {"scale": [0.001] * 3, "translation": [-0.5, -0.5, -0.5]}
    file.texture["extensions"] = {"KHR_texture_transform": {"scale": [1 / 4000, 1 / 4000]}}
    file.header["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_texture_transform"]
    return file.write(folder)


@odd
def interleaved(folder: Path) -> Path:
    file = Gltf()
    view = file.view(np.hstack([CORNERS, UV]).astype(np.float32).tobytes(), byteStride=20)
    file.attributes["POSITION"] = file.accessor(CORNERS, view=view)
    file.attributes["TEXCOORD_0"] = file.accessor(UV, view=view, byteOffset=12)
    return file.write(folder)


@odd
def sparse(folder: Path) -> Path:
    """Positions with one corner replaced, coordinates that are zero but for three."""
    wrong = CORNERS.copy()
    wrong[2] = 9
    file = Gltf(wrong)
    rows, uv_rows = np.array([2], np.uint8), np.array([0, 1, 2], np.uint16)
    accessors = file.header["accessors"]
    accessors[file.attributes["POSITION"]]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": file.view(rows.tobytes()), "componentType": 5121},
        "values": {"bufferView": file.view(CORNERS[rows].tobytes())},
    }
    coordinates = accessors[file.attributes["TEXCOORD_0"]]
    del coordinates["bufferView"]
    coordinates["sparse"] = {
        "count": 3,
        "indices": {"bufferView": file.view(uv_rows.tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(UV[uv_rows].tobytes())},
    }
    return file.write(folder)


@odd
def moved_texture(folder: Path) -> Path:
    """Coordinates from which scale, a quarter turn counter-clockwise and offset make the plain ones."""
    file = Gltf(uv=(np.stack([UV[:, 1] - 0.5, 1 - UV[:, 0] + 0.25], axis=1) * [-2, 2]).astype(np.float32))
    moved = {"scale": [-0.5, 0.5], "rotation": -np.pi / 2, "offset": [1.25, 0.5]}
    file.texture["extensions"] = {"KHR_texture_transform": moved}
    file.header["extensionsUsed"] = ["KHR_texture_transform"]
    return file.write(folder)


@odd
def second_coordinates(folder: Path) -> Path:
    file = Gltf(uv=np.zeros_like(UV))
    file.attributes["TEXCOORD_1"] = file.accessor(UV)
    file.texture["texCoord"] = 1
    return file.write(folder)


@odd
def second_coordinates_by_the_transform(folder: Path) -> Path:
    file = Gltf(uv=np.zeros_like(UV))
    file.attributes["TEXCOORD_1"] = file.accessor(UV)
    file.texture["extensions"] = {"KHR_texture_transform": {"texCoord": 1}}
    return file.write(folder)


@odd
def mirrored(folder: Path) -> Path:
    file = Gltf(uv=(UV * [-1, 1] + [2, -4]).astype(np.float32))
    file.header["samplers"], file.header["textures"][0]["sampler"] = [{"wrapS": MIRROR}], 0
    return file.write(folder)


@odd
def triangle_fan(folder: Path) -> Path:
    file = Gltf()
    file.primitive |= {"mode": 6, "indices": file.accessor(np.arange(4, dtype=np.uint8))}
    return file.write(folder)


@odd
def triangle_fan_without_indices(folder: Path) -> Path:
    file = Gltf()
    del file.primitive["indices"]
    file.primitive["mode"] = 6
    return file.write(folder)


@odd
def triangle_strip(folder: Path) -> Path:
    file = Gltf()
    file.primitive |= {"mode": 5, "indices": file.accessor(np.array([0, 1, 3, 2], np.uint8))}
    return file.write(folder)


@odd
def below_a_camera(folder: Path) -> Path:
    file = Gltf()
    file.header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    file.header["nodes"] = [{"camera": 0, "children": [1], "scale": [3, 3, 3]}, file.node]
    return file.write(folder)


@odd
def beside_what_is_hidden(folder: Path) -> Path:
    file = Gltf()
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2], "mesh": 0, "scale": [2, 2, 2]}
    file.header["nodes"] = [file.node, hidden, {"mesh": 0, "translation": [3, 0, 0]}]
    file.header["scenes"] = [{"nodes": [0, 1]}]
    file.header["extensionsRequired"] = ["KHR_node_visibility"]
    return file.write(folder)


@odd
def webp(folder: Path) -> Path:
    file = Gltf(image=encoded(picture(), "WEBP"))
    file.header["textures"] = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    file.header["extensionsRequired"] = ["EXT_texture_webp"]
    return file.write(folder)


@odd
def unreadable_format_with_a_png_beside_it(folder: Path) -> Path:
    file = Gltf()
    file.header["images"].append({"bufferView": file.view(b"KTX 20"), "mimeType": "image/ktx2"})
    file.header["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": 1}}
    return file.write(folder)


@odd
def image_in_the_text(folder: Path) -> Path:
    file = Gltf()
    data = base64.b64encode(encoded(picture().quantize(4))).decode()
    file.header["images"] = [{"uri": f"data:image/png;base64,{data}"}]
    return file.write(folder, "gltf")


@odd
def image_with_a_space(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    picture().save(folder / "a picture.png")
    file = Gltf()
    file.header["images"] = [{"uri": "A%20picture.png"}]
    return file.write(folder, "gltf")


# ---------------------------------------------------------------- OBJ and PLY

VERTICES = "v -.5 -.5 0\nv .5 -.5 0\nv .5 .5 0\nv -.5 .5 0\n"
SQUARE = f"{VERTICES}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"


def write_obj(
    folder: Path, text: str = f"mtllib a.mtl\n{SQUARE}", mtl: str = "newmtl m\nmap_Kd tex.png\n", image: str = "tex.png"
) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "a.mtl").write_text(mtl, encoding="utf-8")
    (folder / image).parent.mkdir(exist_ok=True)
    picture().save(folder / image)
    path = folder / "odd.obj"
    path.write_text(text, encoding="utf-8")
    return path


TEXTURE_NAMES = {
    "obj": "tex.png",
    "obj_backslash": ".\\tex.png",
    "obj_letter_case": "TEX.Png",
    "obj_percent": "%74ex.png",
    "obj_windows_path": "C:\\Users\\somebody\\tex.png",
    "obj_other_folder": "/nowhere/at/all/tex.png",
    "obj_options": "-blendu on -mm 0 1 -bm 1 -s 1 1 1 -o 0 0 -texres 512 tex.png",
}
for name, texture in TEXTURE_NAMES.items():
    ODD[name] = lambda folder, texture=texture: write_obj(folder, mtl=f"newmtl m\nmap_Kd {texture}\n")


@odd
def obj_scaled_texture(folder: Path) -> Path:
    coordinates = "vt -2 -.5\nvt 0 -.5\nvt 0 .5\nvt -2 .5\n"  # u / 2 + 1, v + 1 / 2
    text = f"mtllib a.mtl\n{VERTICES}{coordinates}usemtl m\nf 1/1 2/2 3/3 4/4\n"
    return write_obj(folder, text, "newmtl m\nmap_Kd -s .5 1 1 -o 1 .5 0 tex.png\n")


@odd
def obj_folder_above(folder: Path) -> Path:
    path = write_obj(folder, mtl="newmtl m\nmap_Kd ../textures/tex.png\n", image="textures/tex.png")
    below = folder / "meshes"
    below.mkdir()
    for file in (path, folder / "a.mtl"):
        file.rename(below / file.name)
    return below / path.name


@odd
def obj_texture_beside_its_material_file(folder: Path) -> Path:
    path = write_obj(folder, f"mtllib materials\\A.mtl\n{SQUARE}")
    below = folder / "materials"
    below.mkdir()
    for name in ("a.mtl", "tex.png"):
        (folder / name).rename(below / name)
    return path


@odd
def obj_byte_order_marks(folder: Path) -> Path:
    return write_obj(folder, f"\ufeffmtllib a.mtl\n{SQUARE}", "\ufeffnewmtl m\nmap_Kd tex.png\n")


@odd
def obj_several_material_files(folder: Path) -> Path:
    path = write_obj(folder, f"# mtllib x\nmtllib b.mtl a.mtl\nmtllib c d.mtl\n{SQUARE}")
    (folder / "b.mtl").write_text("newmtl other\nKd 1 0 0\n")
    (folder / "c d.mtl").write_text("newmtl third\nKd 1 0 0\nmap_Kd missing_but_unused.png\n")
    return path


@odd
def obj_without_usemtl(folder: Path) -> Path:
    return write_obj(folder, f"mtllib a.mtl\n{SQUARE.replace('usemtl m', '')}")


@odd
def obj_counting_backwards(folder: Path) -> Path:
    halves = [
        "v -.5 -.5 0\nv .5 -.5 0\nv .5 .5 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl m\nf -3/-3 -2/-2 -1/-1\n",
        "v -.5 -.5 0\nv .5 .5 0\nv -.5 .5 0\nvt 0 0\nvt 1 1\nvt 0 1\nf -3/-3 -2/-2 -1/-1\n",
    ]
    return write_obj(folder, "mtllib a.mtl\n" + "".join(halves))


@odd
def obj_lines_of_the_old_mac(folder: Path) -> Path:
    return write_obj(folder, f"mtllib a.mtl\n{SQUARE}".replace("\n", "\r"))


PLY = """ply
format ascii 1.0
{comments}element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 2
property list uchar int vertex_indices
end_header
-.5 -.5 0 0 0
.5 -.5 0 1 0
.5 .5 0 1 1
-.5 .5 0 0 1
3 0 1 2
3 0 2 3
"""


@odd
def ply(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    picture().save(folder / "a tex.png")
    path = folder / "odd.ply"
    path.write_text(PLY.format(comments="comment TextureFile A tex.PNG\n"))
    return path


# ---------------------------------------------------------------- others than the plain square

PLACES = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0]], np.float32)


@other
def instances(folder: Path) -> Path:
    """Squares at `PLACES`, the second turned by a quarter, the third half as large."""
    file = Gltf()
    turn = np.sqrt(0.5)
    attributes = {
        "TRANSLATION": file.accessor(PLACES),
        "ROTATION": file.accessor(scaled(np.int16, [[0, 0, 0, 1], [0, 0, turn, turn], [0, 0, 0, 1]]), normalized=True),
        "SCALE": file.accessor(np.array([[1, 1, 1], [1, 1, 1], [0.5, 0.5, 0.5]], np.float32)),
    }
    file.node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    file.header["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    return file.write(folder)


def wrapping(wrap: dict[str, int]) -> Writer:
    """A square with coordinates from -1 to 2 across and up."""

    def write(folder: Path) -> Path:
        file = Gltf(uv=3 * UV - 1)
        file.header["samplers"], file.header["textures"][0]["sampler"] = [wrap], 0
        return file.write(folder)

    return write


OTHER["clamped"] = wrapping({"wrapS": CLAMP, "wrapT": CLAMP})
OTHER["mirrored_many_times"] = wrapping({"wrapS": MIRROR, "wrapT": MIRROR})
OTHER["wrapped_in_two_ways"] = wrapping({"wrapS": CLAMP, "wrapT": MIRROR})
OTHER["repeated"] = wrapping({})
OTHER["obj_clamped"] = lambda folder: write_obj(
    folder, f"mtllib a.mtl\n{SQUARE.replace('vt 0', 'vt -1')}", "newmtl m\nmap_Kd -clamp on tex.png\n"
)

LINEAR = np.array([[0, 0, 1], [1, 1, 0], [0.2, 0.5, 0.1], [1, 0, 0]], np.float32)  # of the square's corners


def coloured(kind: type, alpha: bool = False, **settings: Any) -> Writer:
    """A square with the vertex colours `LINEAR` in a component type, beside a material."""

    def write(folder: Path) -> Path:
        file = Gltf(**settings)
        colours = np.pad(LINEAR, ((0, 0), (0, 1)), constant_values=0.5) if alpha else LINEAR
        if kind is not np.float32:
            colours = scaled(kind, colours)
        row = -(-colours[0].nbytes // 4) * 4  # rows begin at multiples of 4 bytes
        padded = np.zeros((4, row), np.uint8)
        padded[:, : colours[0].nbytes] = colours.view(np.uint8).reshape(4, -1)
        view = file.view(padded.tobytes(), byteStride=row)
        file.attributes["COLOR_0"] = file.accessor(colours, kind is not np.float32, view)
        file.material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 0.4, 0.2, 1]
        return file.write(folder)

    return write


COLOURED = {
    f"{kind.__name__}_{'rgba' if alpha else 'rgb'}": coloured(kind, alpha, uv=None, image=None)
    for kind in (np.uint8, np.uint16, np.float32)
    for alpha in (False, True)
}
OTHER |= COLOURED
OTHER["coloured_texture"] = coloured(np.uint8)


@other
def coordinates_that_are_not_numbers(folder: Path) -> Path:
    """One triangle of two."""
    return write_obj(folder, f"mtllib a.mtl\n{SQUARE.replace('vt 1 0', 'vt nan 0')}")


@other
def coordinates_without_end(folder: Path) -> Path:
    return write_obj(folder, f"mtllib a.mtl\n{SQUARE.replace('vt 1 0', 'vt 1e30 -inf')}")


@other
def one_corner_nowhere(folder: Path) -> Path:
    """The triangle of corners 0, 2, 3 remains, beside one that has a corner at infinity."""
    corners = CORNERS.copy()
    corners[1] = np.inf
    return Gltf(corners).write(folder)


@other
def texture_of_16_bits(folder: Path) -> Path:
    levels = (np.mgrid[0:16, 0:16].sum(axis=0) * 2000 + 3000).astype(np.uint16)
    return Gltf(image=encoded(Image.fromarray(levels))).write(folder)


@other
def obj_colours(folder: Path) -> Path:
    return write_obj(folder, COLOURED_VERTICES + "f 1 2 3 4\n")


SRGB = [(0, 0, 1), (1, 1, 0), (0.2, 0.5, 0.1), (1, 0, 0)]
COLOURED_VERTICES = "".join(
    f"{line} {r} {g} {b}\n" for line, (r, g, b) in zip(VERTICES.splitlines(), SRGB, strict=True)
)
COLOURED_SQUARE = SQUARE.replace(VERTICES, COLOURED_VERTICES)


@other
def obj_colours_beside_coordinates(folder: Path) -> Path:
    return write_obj(folder, COLOURED_SQUARE.replace("usemtl m\n", ""))


@other
def obj_colours_beside_a_material(folder: Path) -> Path:
    return write_obj(folder, f"mtllib a.mtl\n{COLOURED_SQUARE}", "newmtl m\nKa .2 .2 .2\nKd .75 .75 .75\n")


@other
def obj_colours_up_to_255(folder: Path) -> Path:
    lines = zip(VERTICES.splitlines(), SRGB, strict=True)
    vertices = "".join(f"{line} {255 * r} {255 * g} {255 * b}\n" for line, (r, g, b) in lines)
    return write_obj(folder, vertices + "f 1 2 3 4\n")


def ply_colours(kind: str, scale: float, coordinates: bool) -> Writer:
    def write(folder: Path) -> Path:
        folder.mkdir(exist_ok=True)
        properties = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        text = PLY.format(comments="").replace("element face", f"{properties}element face")
        for line, colour in zip(text.splitlines()[-6:-2], SRGB, strict=True):
            levels = " ".join(f"{scale * level:g}" for level in colour)
            text = text.replace(f"\n{line}\n", f"\n{line} {levels}\n")
        if not coordinates:
            text = text.replace("float s", "float quality").replace("float t", "float other")
        path = folder / "odd.ply"
        path.write_text(text)
        return path

    return write


OTHER |= {
    "ply_colours": ply_colours("uchar", 255, False),
    "ply_colours_of_16_bits": ply_colours("ushort", 65535, False),
    "ply_colours_as_fractions": ply_colours("float", 1, False),
    "ply_colours_beside_coordinates": ply_colours("uchar", 255, True),
}
