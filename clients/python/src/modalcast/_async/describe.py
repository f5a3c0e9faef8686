"""Reads descriptions of scenes, their arrays, and rows of U."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from modalcast._async.transport import ReplyStream, Transport
from modalcast._chunks import Assembly, ChunkFormat, malformed
from modalcast._decoders import parse
from modalcast._methods import DESCRIBE_SCENE, READ_CONTENT, READ_MODES
from modalcast._types import F32, Bytes
from modalcast.kinematics import AttachmentPoints, has_fit
from modalcast.scene_description import (
    ARRAY_NAMES,
    ArrayName,
    Domain,
    Domains,
    SceneDescription,
    Shape,
    Texture,
    array_enum_values,
    decode_array,
    domain_from_message,
    material_from_message,
    shape_from_message,
    texture_from_message,
)
from modalcast.states import StateLayout
from modalcast.v1 import scenes_pb2

# Number of hashes in one request; the limit of the server.
_HASHES_PER_REQUEST = 4096

_ARRAY_CHUNK = ChunkFormat("describe.chunk", scenes_pb2.ArrayChunk, chunk_field=6, data_field=5)
_CONTENT_CHUNK = ChunkFormat("content", scenes_pb2.ReadContentResponse, chunk_field=None, data_field=4)
_MODES_CHUNK = ChunkFormat("modes", scenes_pb2.ReadModesResponse, chunk_field=None, data_field=4)


async def read_description(
    transport: Transport,
    scene: str,
    domains: Sequence[int],
    arrays: Sequence[ArrayName],
    *,
    textures: bool,
    hashes: bool,
    cache: str | None,
    timeout: float,
) -> SceneDescription:
    """Reads a description; `Scene.describe` documents the arguments."""
    by_hash = textures or cache is not None
    request = scenes_pb2.DescribeSceneRequest(
        scene=scene,
        domains=domains,
        arrays=[] if cache is not None else array_enum_values(arrays),
        hashes=hashes or by_hash,
    )
    description = await _read_parts(transport.stream(DESCRIBE_SCENE, request, timeout))
    if not by_hash:
        return description
    array_enum_values(arrays)  # Raises if a name is unknown.
    wanted: dict[bytes, int] = {}
    if cache is not None:
        for shape in description.shapes.values():
            wanted.update({shape.hashes[name]: shape.sizes[name] for name in arrays if name in shape.hashes})
    if textures:
        wanted.update({texture.sha256: 4 * texture.width * texture.height for texture in description.textures.values()})
    contents = await _read_contents(transport, scene, wanted, cache, timeout)
    if cache is not None:
        for shape in description.shapes.values():
            for name in arrays:
                content = contents[shape.hashes[name]] if name in shape.hashes else np.empty(0, np.uint8)
                shape.arrays[name] = decode_array(shape, name, content)
    if not textures:
        return description
    with_pixels = {index: _with_pixels(texture, contents) for index, texture in description.textures.items()}
    return replace(description, textures=with_pixels)


def _with_pixels(texture: Texture, contents: dict[bytes, Bytes]) -> Texture:
    pixels = contents[texture.sha256]
    if len(pixels) != 4 * texture.width * texture.height:
        raise malformed("textures.pixels", f"{4 * texture.width * texture.height} bytes", str(len(pixels)))
    return replace(texture, pixels=pixels.reshape(texture.height, texture.width, 4))


async def _read_parts(stream: ReplyStream) -> SceneDescription:
    info = scenes_pb2.SceneInfo()
    shapes: dict[int, Shape] = {}
    domains: list[Domain] = []
    description = SceneDescription(info, Domains([]), shapes, {}, {})
    materials = dict(description.materials)
    textures = dict(description.textures)
    assembly: Assembly | None = None
    while (message := await stream.read()) is not None:
        parsed = _ARRAY_CHUNK.parse(message)
        if parsed is not None:
            chunk, data = parsed
            if chunk.shape not in shapes or chunk.array not in ARRAY_NAMES:
                raise malformed("describe.chunk", "an array of a described shape", f"array {chunk.array}")
            assembly = assembly or Assembly("describe.chunk", chunk.total, np.empty(0, np.uint8))
            if assembly.add(chunk.offset, data):
                name = ARRAY_NAMES[chunk.array]
                shapes[chunk.shape].arrays[name] = decode_array(shapes[chunk.shape], name, assembly.bytes)
                assembly = None
            continue
        part = parse("describe", scenes_pb2.DescribeSceneResponse, message)
        if part.HasField("scene"):
            info = part.scene
        shapes.update({shape.shape: shape_from_message(shape) for shape in part.shapes.shapes})
        materials.update({material.material: material_from_message(material) for material in part.materials.materials})
        textures.update({texture.texture: texture_from_message(texture) for texture in part.textures.textures})
        domains.extend(domain_from_message(domain, shapes) for domain in part.domains.domains)
    if assembly is not None:
        raise malformed("describe.chunk", f"{assembly.total} bytes", f"the end of the stream after {assembly.received}")
    return SceneDescription(info, Domains(domains), shapes, materials, textures)


async def _read_contents(
    transport: Transport, scene: str, wanted: dict[bytes, int], cache: str | None, timeout: float
) -> dict[bytes, Bytes]:
    """The contents with the wanted hashes, by hash, from the folder `cache` or from the server."""
    contents: dict[bytes, Bytes] = {}
    if cache is not None:
        Path(cache).mkdir(parents=True, exist_ok=True)
        for sha256 in wanted:
            path = Path(cache, sha256.hex())
            stored = path.read_bytes() if path.exists() else None
            if stored is not None and hashlib.sha256(stored).digest() == sha256:
                contents[sha256] = np.frombuffer(stored, np.uint8)
    missing = [sha256 for sha256 in wanted if sha256 not in contents]
    for start in range(0, len(missing), _HASHES_PER_REQUEST):
        asked = missing[start : start + _HASHES_PER_REQUEST]
        request = scenes_pb2.ReadContentRequest(scene=scene, sha256=asked)
        received = await _read_items(transport.stream(READ_CONTENT, request, timeout), len(asked))
        for sha256, content in zip(asked, received, strict=True):
            if hashlib.sha256(content.tobytes()).digest() != sha256:
                raise malformed("content", f"the SHA-256 {sha256.hex()}", "another content")
            contents[sha256] = content
            if cache is not None:
                _store(Path(cache, sha256.hex()), content)
    return contents


async def _read_items(stream: ReplyStream, count: int) -> list[Bytes]:
    items: list[Bytes] = []
    assembly: Assembly | None = None
    while (message := await stream.read()) is not None:
        parsed = _CONTENT_CHUNK.parse(message)
        if parsed is None:
            continue
        chunk, data = parsed
        if chunk.item != len(items):
            raise malformed("content.item", str(len(items)), str(chunk.item))
        assembly = assembly or Assembly("content", chunk.total, np.empty(0, np.uint8))
        if assembly.add(chunk.offset, data):
            items.append(assembly.bytes)
            assembly = None
    if len(items) != count:
        raise malformed("content", f"{count} contents", str(len(items)))
    return items


def _store(path: Path, content: Bytes) -> None:
    """Writes a file and renames it, so that other processes see a complete file or none."""
    incomplete = path.with_suffix(".part")
    incomplete.write_bytes(content.tobytes())
    incomplete.replace(path)


async def read_modes(transport: Transport, scene: str, domain: int, vertices: Sequence[int], timeout: float) -> F32:
    """Rows of U of a domain: 3k x r, for k vertices or for all."""
    request = scenes_pb2.ReadModesRequest(scene=scene, domain=domain, vertices=vertices)
    stream = transport.stream(READ_MODES, request, timeout)
    assembly: Assembly | None = None
    rank = 0
    while (message := await stream.read()) is not None:
        parsed = _MODES_CHUNK.parse(message)
        if parsed is None:
            continue
        chunk, data = parsed
        rank = chunk.rank
        assembly = assembly or Assembly("modes", chunk.total, np.empty(0, np.uint8))
        assembly.add(chunk.offset, data)
    if assembly is None or assembly.received != assembly.total:
        raise malformed("modes", "complete rows of U", "the end of the stream")
    if rank == 0:
        return np.empty((3 * len(vertices), 0), np.float32)
    return assembly.bytes.view("<f4").reshape(-1, rank)


async def read_attachments(
    transport: Transport, scene: str, layout: StateLayout, timeout: float
) -> dict[int, AttachmentPoints]:
    """The attachment vertices of all attached domains that the modes of their parents move, by index of the domain."""
    fitted = [domain for domain in layout.domains if has_fit(domain, layout)]
    parents = sorted({domain.parent for domain in fitted if domain.parent is not None})
    if not parents:
        return {}

    async def describe(domains: list[int], array: ArrayName) -> SceneDescription:
        return await read_description(
            transport, scene, domains, [array], textures=False, hashes=False, cache=None, timeout=timeout
        )

    description = await describe(parents, "rest_positions")
    centered = [parent.index for parent in description.domains if description.shape_of(parent).origin.any()]
    if centered:
        for index, shape in (await describe(centered, "centered_positions")).shapes.items():
            description.shapes[index].arrays.update(shape.arrays)
    points: dict[int, AttachmentPoints] = {}
    for parent in description.domains:
        children = [domain for domain in fitted if domain.parent == parent.index]
        vertices = np.unique(np.concatenate([child.attachment_vertices for child in children]))
        modes = await read_modes(transport, scene, parent.index, vertices.tolist(), timeout)
        modes = modes.reshape(len(vertices), 3, parent.rank)
        rest_positions = description.shape_of(parent).exact_positions
        for child in children:
            places = np.searchsorted(vertices, child.attachment_vertices)
            rest = rest_positions[child.attachment_vertices]
            points[child.index] = AttachmentPoints(rest, modes[places].reshape(-1, parent.rank))
    return points
