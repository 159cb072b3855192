"""glTF according to the standard (2.0).

trimesh reads a scene's nodes, triangles, materials and images, and ignores the rest. Other features are converted to
supported ones before trimesh sees the file, rejected with an error, or reported in a warning; files without them are
passed on unchanged.
"""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.resolvers import ZipResolver
from trimesh.visual import TextureVisuals

from lp_framework.data.mesh_files.common import (
    LINEAR_COLOUR,
    REPEAT,
    WRAP,
    find,
    readable_image,
    warn,
    warn_of_texture,
)
from lp_framework.errors import UserError

SUPPORTED = (
    "KHR_mesh_quantization", "KHR_texture_transform", "EXT_mesh_gpu_instancing", "EXT_texture_webp",
    "EXT_texture_avif", "MSFT_texture_dds", "KHR_node_visibility",
    # These define shading or light sources.
    "KHR_materials_", "KHR_lights_", "EXT_lights_",
)  # fmt: skip
COLOUR_TEXTURES, GLOSS_TEXTURE = ("baseColorTexture", "diffuseTexture"), "specularGlossinessTexture"
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
UNSIGNED_INT, FLOAT = 5125, 5126
TRIANGLES, TRIANGLE_FAN = 4, 6


def read_gltf(path: Path) -> trimesh.Scene:
    """Read a .gltf or .glb file. Meshes have vertex colours, if any, in `vertex_attributes[LINEAR_COLOUR]` and their
    texture's wrap modes in `metadata[WRAP]`. Raises `UserError` for an unsupported required extension."""
    file = _File(path)
    file.instances()
    textures = file.textures()
    for mesh in file.header.get("meshes", []):
        for primitive in mesh["primitives"]:
            file.geometry(primitive)
            file.colours(primitive)
            file.texture_coordinates(primitive, textures)
    file.warn_of_ignored()
    scene = file.scene()
    for mesh in scene.geometry.values():
        if isinstance(getattr(mesh, "visual", None), TextureVisuals):
            mesh.metadata[WRAP] = file.wrap(textures.get(int(mesh.visual.material.name)))
    return scene


class _File:
    """The header of a glTF file and its buffers; methods rewrite the header and append buffers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header, chunk = _parts(path.read_bytes())
        for extension in self.header.get("extensionsRequired", []):
            if not extension.startswith(SUPPORTED):
                raise self._unsupported(extension)
        self.buffers: list[bytes] = []
        self.images: dict[int, bytes | None] = {}  # images of textures, by index
        for buffer in self.header.get("buffers", []):
            if "uri" not in buffer and "extensions" in buffer:
                raise self._unsupported(next(iter(buffer["extensions"])))
            data = self._named(buffer["uri"]) if "uri" in buffer else chunk
            if data is None:
                raise UserError(f"{path}: its file {buffer['uri']} is missing")
            self.buffers.append(data)

    def scene(self) -> trimesh.Scene:
        """Load the rewritten file with trimesh; the name of a material is its index."""
        files = {f"buffer{index}": buffer for index, buffer in enumerate(self.buffers)}
        files |= {f"image{index}": image for index, image in self.images.items() if image is not None}
        for index, buffer in enumerate(self.header.get("buffers", [])):
            buffer["uri"] = f"buffer{index}"
        for index, material in enumerate(self.header.get("materials", [])):
            material["name"] = str(index)
        for node in self.header.get("nodes", []):
            node.pop("camera", None)  # trimesh drops the children of cameras
            if not node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
                node.pop("mesh", None)
                node.pop("children", None)
        # Only images that colour the object are drawn.
        self.header["images"] = [{"uri": f"image{index}"} for index in range(len(self.header.get("images", [])))]
        header = io.BytesIO(json.dumps(self.header).encode())
        return trimesh.load_scene(header, file_type="gltf", resolver=ZipResolver(files))

    def _unsupported(self, extension: str) -> UserError:
        return UserError(
            f"{self.path}: needs the glTF extension {extension}, which is not supported; save it without that extension"
        )

    def _named(self, uri: str) -> bytes | None:
        if uri.startswith("data:"):
            return urlopen(uri).read()
        found = find(uri, [self.path.parent])
        return None if found is None else found.read_bytes()

    # ------------------------------------------------------------ accessors

    def _values(self, index: int) -> NDArray[Any]:
        """The values `[count, components]` of an accessor; normalized integers become floats."""
        accessor = self.header["accessors"][index]
        kind, components = np.dtype(TYPES[accessor["componentType"]]), COMPONENTS[accessor["type"]]
        values = np.zeros((accessor["count"], components), kind)
        if "bufferView" in accessor:
            values[:] = self._view(accessor, kind, *values.shape)
        if sparse := accessor.get("sparse"):
            indices, replaced = sparse["indices"], sparse["values"]
            rows = self._view(indices, np.dtype(TYPES[indices["componentType"]]), sparse["count"], 1)[:, 0]
            values[rows] = self._view(replaced, kind, sparse["count"], components)
        return np.maximum(values / np.iinfo(kind).max, -1) if accessor.get("normalized") else values

    def _view(self, place: dict[str, Any], kind: np.dtype[Any], count: int, components: int) -> NDArray[Any]:
        view = self.header["bufferViews"][place["bufferView"]]
        start = view.get("byteOffset", 0) + place.get("byteOffset", 0)
        strides = (view.get("byteStride", components * kind.itemsize), kind.itemsize)
        return np.ndarray((count, components), kind, self.buffers[view["buffer"]], start, strides)

    def _store(self, values: NDArray[Any]) -> int:
        """The index of a new accessor with the values `[count, components]`, unsigned integers or else floats."""
        kind = UNSIGNED_INT if values.dtype.kind == "u" else FLOAT
        data = np.ascontiguousarray(values, TYPES[kind]).tobytes()
        view = {"buffer": len(self.buffers), "byteLength": len(data)}
        accessor = {"componentType": kind, "count": len(values), "type": [*COMPONENTS][values.shape[1] - 1]}
        self.header["accessors"].append({"bufferView": len(self.header["bufferViews"]), **accessor})
        self.header["bufferViews"].append(view)
        self.header["buffers"].append({"byteLength": len(data)})
        self.buffers.append(data)
        return len(self.header["accessors"]) - 1

    # ------------------------------------------------------------ meshes

    def geometry(self, primitive: dict[str, Any]) -> None:
        """Replace normalized and sparse accessors of positions and indices, and convert fans to triangles."""
        attributes, accessors = primitive["attributes"], self.header["accessors"]
        compressed = [name for name in primitive.pop("extensions", {}) if not name.startswith(SUPPORTED)]
        if compressed and not {"bufferView", "sparse"} & set(accessors[attributes["POSITION"]]):
            raise self._unsupported(compressed[0])
        for holder, key in ((attributes, "POSITION"), (primitive, "indices")):
            if key in holder and {"sparse", "normalized"} & set(accessors[holder[key]]):
                holder[key] = self._store(self._values(holder[key]))
        if primitive.get("mode") == TRIANGLE_FAN:
            around = np.arange(accessors[attributes["POSITION"]]["count"], dtype=np.uint32)
            if "indices" in primitive:
                around = self._values(primitive["indices"])[:, 0]
            fan = np.stack([np.full_like(around[2:], around[0]), around[1:-1], around[2:]], axis=1)
            primitive |= {"mode": TRIANGLES, "indices": self._store(fan.reshape(-1, 1))}

    def colours(self, primitive: dict[str, Any]) -> None:
        """Move vertex colours to our own attribute, as floats, because trimesh assumes 8-bit sRGB."""
        if (index := primitive["attributes"].pop("COLOR_0", None)) is not None:
            colours = self._values(index)
            if colours.dtype.kind != "f":
                colours = colours / np.iinfo(colours.dtype).max
            primitive["attributes"][LINEAR_COLOUR] = self._store(colours)

    def texture_coordinates(self, primitive: dict[str, Any], textures: dict[int, dict[str, Any]]) -> None:
        """Make the texture's coordinates the first ones, with the texture's transform applied."""
        texture, attributes = textures.get(primitive.get("material", -1)), primitive["attributes"]
        transform = {} if texture is None else texture.get("extensions", {}).get("KHR_texture_transform", {})
        number = 0 if texture is None else transform.get("texCoord", texture.get("texCoord", 0))
        index = attributes.pop(f"TEXCOORD_{number}", None)
        if index is None:
            attributes.pop("TEXCOORD_0", None)
            return
        accessor = self.header["accessors"][index]
        if transform or accessor["componentType"] != FLOAT or "sparse" in accessor:
            angle, scale = transform.get("rotation", 0.0), transform.get("scale", (1.0, 1.0))
            # Counter-clockwise on screen, because v points down.
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            index = self._store(self._values(index) * scale @ turn.T + transform.get("offset", (0.0, 0.0)))
        attributes["TEXCOORD_0"] = index

    def instances(self) -> None:
        """Create a separate node for each instance of a mesh (EXT_mesh_gpu_instancing)."""
        for node in [*self.header.get("nodes", [])]:
            if instancing := node.get("extensions", {}).get("EXT_mesh_gpu_instancing"):
                mesh, attributes = node.pop("mesh"), instancing["attributes"]
                keys = [key for key in ("TRANSLATION", "ROTATION", "SCALE") if key in attributes]
                for place in zip(*(self._values(attributes[key]).tolist() for key in keys), strict=True):
                    node.setdefault("children", []).append(len(self.header["nodes"]))
                    moved = {key.lower(): values for key, values in zip(keys, place, strict=True)}
                    self.header["nodes"].append({"mesh": mesh, **moved})

    def warn_of_ignored(self) -> None:
        """Warn of skins and morph targets that are not applied."""
        nodes, meshes = self.header.get("nodes", []), self.header.get("meshes", [])
        if any("skin" in node for node in nodes):
            warn(self.path, "its skeleton (skins) is left out; it is drawn as its meshes are modelled")
        if any(any(each.get("weights", [])) for each in (*nodes, *meshes)):
            warn(self.path, "its morph targets are left out; it is drawn as its meshes are modelled")

    # ------------------------------------------------------------ textures

    def textures(self) -> dict[int, dict[str, Any]]:
        """The reference to the colour texture of each material; sets each texture's source to a readable image."""
        found, wanted = {}, set()
        for index, material in enumerate(self.header.get("materials", [])):
            colours = material.get("pbrMetallicRoughness", {})
            colours = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", colours)
            # trimesh computes the colour of specular-glossiness materials from both of their textures.
            wanted |= {colours[key]["index"] for key in (*COLOUR_TEXTURES, GLOSS_TEXTURE) if key in colours}
            for key in COLOUR_TEXTURES:
                if key in colours:
                    found[index] = colours[key]
        for number in sorted(wanted):
            self._choose_source(self.header["textures"][number])
        return found

    def _choose_source(self, texture: dict[str, Any]) -> None:
        """Choose the first readable image of a texture; extensions take precedence over its own source."""
        named = []
        for each in (*texture.pop("extensions", {}).values(), {"source": texture.pop("source", None)}):
            if (source := each.get("source")) is None:
                continue
            image = self.header["images"][source]
            if source not in self.images and "bufferView" in image:
                length = self.header["bufferViews"][image["bufferView"]]["byteLength"]
                self.images[source] = self._view(image, np.dtype("u1"), length, 1).tobytes()
            elif source not in self.images:
                self.images[source] = self._named(image["uri"])
            if readable_image(self.images[source]):
                texture["source"] = source
                return
            uri = image.get("uri", "data:")
            named.append(image.get("mimeType", f"number {source}") if uri.startswith("data:") else uri)
        warn_of_texture(self.path, " or ".join(named) or "without an image")

    def wrap(self, texture: dict[str, Any] | None) -> tuple[int, int]:
        """The wrap modes of a texture, across and up."""
        sampler = {} if texture is None else self.header["textures"][texture["index"]]
        if "sampler" in sampler:
            sampler = self.header["samplers"][sampler["sampler"]]
        return sampler.get("wrapS", REPEAT), sampler.get("wrapT", REPEAT)


def _parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The header of a .gltf or .glb file, and the binary chunk of a .glb file."""
    if data[:4] != b"glTF":
        return json.loads(data.decode("utf-8-sig")), b""
    chunks = {}
    (version, end), start = struct.unpack_from("<II", data, 4), 12
    while start < end:
        length, kind = struct.unpack_from("<I4s", data, start)
        chunks[kind] = data[start + 8 : start + 8 + length]
        start += 8 + length
    if version != 2 or start > len(data):
        raise ValueError(f"it is cut short, or of version {version} instead of 2")
    return json.loads(chunks[b"JSON"]), chunks.get(b"BIN\0", b"")
