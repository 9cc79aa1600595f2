"""glTF 2.0 files: the JSON document, its buffers, and accessors as arrays; nothing outside their folder is read."""

from __future__ import annotations

import base64
import binascii
import contextlib
import dataclasses
import functools
import json
import os
import struct
import typing
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from avatarjax.data.importers import series

_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# What a normalised integer is divided by (glTF 2.0, 3.6.2.2).
_RANGES = {5120: 127.0, 5121: 255.0, 5122: 32767.0, 5123: 65535.0}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
# Extensions that change neither positions nor the base colour's place; others that a file requires are refused.
_HARMLESS = ("KHR_mesh_quantization", "KHR_lights_punctual", "KHR_texture_transform")


@dataclasses.dataclass(frozen=True, eq=False)
class GltfFile:
    """A parsed glTF file: its path, JSON document and, for .glb, binary chunk; `root` bounds the files it may name."""

    path: Path
    document: dict[str, typing.Any]
    chunk: bytes | None
    root: Path

    def entries(self, kind: str) -> list[dict[str, typing.Any]]:
        """The objects of one kind ("nodes", "meshes", ...), [] where there are none."""
        found = self.document.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise ValueError(f"{self.path} is damaged: its {kind} are no list of objects")
        return found

    def entry(self, kind: str, index: typing.Any) -> dict[str, typing.Any]:
        """One object of a kind; ValueError that names the file where there is none of that index."""
        found = self.entries(kind)
        if not isinstance(index, int) or not 0 <= index < len(found):
            raise ValueError(f"{self.path} refers to {kind} {index!r}, it has {len(found)}: export it again")
        return found[index]

    @functools.cached_property
    def _buffers(self) -> dict[int, bytes]:
        return {}

    def buffer(self, index: int) -> bytes:
        """The bytes of a buffer: the binary chunk, a data URI, or a file beside it inside `root`."""
        if index not in self._buffers:
            uri = self.entry("buffers", index).get("uri")
            if uri is None:
                if self.chunk is None or index:
                    raise ValueError(
                        f"{self.path}: buffer {index} has neither a uri nor a binary chunk: export it again"
                    )
                self._buffers[index] = self.chunk
            else:
                self._buffers[index] = self.resource(uri)
        return self._buffers[index]

    def resource(self, uri: str) -> bytes:
        """What a URI names: a data URI's bytes or those of a file inside `root`; ValueError for anything else."""
        if uri.startswith("data:"):
            header, _, data = uri.partition(",")
            try:
                return base64.b64decode(data, validate=True) if header.endswith(";base64") else data.encode()
            except binascii.Error as error:
                raise ValueError(f"{self.path} has a damaged data URI ({error}): export it again") from error
        target = series.inside(self.root, self.path.parent, urllib.parse.unquote(uri), self.path)
        if not target.is_file():
            raise ValueError(f"{self.path} needs {uri!r}, which is missing: copy it to {self.path.parent}")
        return target.read_bytes()

    def view(self, index: int) -> tuple[bytes, int, int, int | None]:
        """A buffer view as (bytes of its buffer, start, end, stride)."""
        view = self.entry("bufferViews", index)
        data = self.buffer(view["buffer"])
        start = view.get("byteOffset", 0)
        end = start + view["byteLength"]
        if start < 0 or not start <= end <= len(data):
            raise ValueError(f"{self.path} is truncated: buffer view {index} ends at {end} of {len(data)} bytes")
        return data, start, end, view.get("byteStride")

    def accessor(self, index: int) -> np.ndarray:
        """An accessor as (count, width): float64 for floats and normalised integers, integers as they are.

        Sparse values are filled in; matrices are flat, in glTF's column-major order.
        """
        accessor = self.entry("accessors", index)
        component, width, count = accessor["componentType"], _TYPES.get(accessor["type"]), accessor["count"]
        if width is None or component not in _DTYPES:
            raise ValueError(f"{self.path}: accessor {index} is of an unknown type: export it again")
        if "bufferView" in accessor:
            at = accessor["bufferView"], accessor.get("byteOffset", 0)
            values = self._elements(index, *at, np.dtype(_DTYPES[component]), count, width)
        else:
            values = np.zeros((count, width), _DTYPES[component])
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, what = sparse["indices"], sparse["values"]
            places = self._elements(
                index, where["bufferView"], where.get("byteOffset", 0), np.dtype(_DTYPES[where["componentType"]]),
                sparse["count"], 1,
            )[:, 0]  # fmt: skip
            if len(places) and places.max() >= count:
                raise ValueError(f"{self.path}: accessor {index} has a sparse index past its end: export it again")
            values = values.copy()
            values[places] = self._elements(
                index, what["bufferView"], what.get("byteOffset", 0), values.dtype, sparse["count"], width
            )
        if accessor.get("normalized") and component in _RANGES:
            return np.maximum(values / _RANGES[component], -1.0)
        if component != 5126:
            return values
        if not np.isfinite(values).all():
            raise ValueError(f"{self.path}: accessor {index} holds NaN or infinity: repair the animation, export again")
        return values.astype(np.float64)

    def _elements(self, index: int, view: int, offset: int, dtype: np.dtype, count: int, width: int) -> np.ndarray:
        data, start, end, stride = self.view(view)
        size = dtype.itemsize * width
        stride = stride or size
        if count < 1 or offset < 0 or stride < size or start + offset + (count - 1) * stride + size > end:
            raise ValueError(f"{self.path}: accessor {index} reaches past its buffer view: the file is damaged")
        return np.ndarray((count, width), dtype, data, start + offset, (stride, dtype.itemsize))


@contextlib.contextmanager
def damage(path: str | os.PathLike) -> Iterator[None]:
    """Turns what a document with missing or misplaced entries leads to into a ValueError that names the file."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: an entry is missing or of the wrong kind ({error!r})") from error


def read(path: str | os.PathLike, root: Path | None = None) -> GltfFile:
    """Parse a .glb or .gltf file; files that it names must lie in `root` (its folder by default).

    Raises ValueError that names a file which is missing, no glTF 2.0, damaged, or needs an unsupported extension.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    raw, chunk = path.read_bytes(), None
    if not raw:
        raise ValueError(f"{path} is empty: export it again")
    if raw[:4] == b"glTF":
        text, chunk = _chunks(path, raw)
    elif path.suffix.lower() == ".glb":
        raise ValueError(f"{path} is not a binary glTF file: it starts with {raw[:4]!r}")
    else:
        text = raw
    try:
        document = json.loads(text)
        version = str(document["asset"]["version"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no glTF document ({error!r}): export it again") from error
    if not version.startswith("2."):
        raise ValueError(f"{path} is glTF {version}: export it as glTF 2.0")
    required = document.get("extensionsRequired") or []
    needed = [str(e) for e in required if e not in _HARMLESS and "materials" not in str(e)]
    if needed:
        raise ValueError(f"{path} needs the extensions {', '.join(needed)}: export it without compression")
    return GltfFile(path, document, chunk, root or path.parent)


def _chunks(path: Path, raw: bytes) -> tuple[bytes, bytes | None]:
    found, at = {}, 12
    while at + 8 <= len(raw):
        length, kind = struct.unpack_from("<II", raw, at)
        if at + 8 + length > len(raw):
            raise ValueError(f"{path} is truncated: a chunk ends at byte {at + 8 + length} of {len(raw)}")
        found.setdefault(kind, raw[at + 8 : at + 8 + length])
        at += 8 + length
    if _JSON not in found:
        raise ValueError(f"{path} is truncated: it has no JSON chunk")
    return found[_JSON], found.get(_BIN)
