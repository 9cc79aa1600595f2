"""3D Gaussian clouds as .ply files in the layout of the original implementation (INRIA, Kerbl et al. 2023).

Binary little endian, float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_*, opacity (logit), scale_0..2 (logarithm),
rot_0..3 (w, x, y, z). Viewers multiply f_dc by the spherical harmonic of degree 0 and add 0.5; that factor exists only
here. The numbers of f_rest are stored channel by channel.
"""

from __future__ import annotations

import os
import typing
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from avatarjax.gaussians import Gaussians
from avatarjax.io import atomic

# The spherical harmonic of degree 0: sqrt(1 / (4 pi)).
_SH_0 = 0.28209479177387814
_POSITION, _DC = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_NORMAL, _SCALE = ("nx", "ny", "nz"), ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_DTYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_HEADER_LIMIT = 65536


def write_ply(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write one cloud, atomically. Raises ValueError for a batch of clouds."""
    if gaussians.means.ndim != 2:
        raise ValueError(f"a .ply file holds one cloud, got means of shape {gaussians.means.shape}")
    n = gaussians.means.shape[0]
    columns = {name: np.zeros(n) for name in _NORMAL}
    dc = (np.asarray(gaussians.colors, np.float64) - 0.5) / _SH_0
    quats = np.asarray(gaussians.quats)
    fields = ((_POSITION, gaussians.means), (_DC, dc), (_SCALE, gaussians.log_scales), (_ROTATION, quats))
    for names, values in fields:
        columns.update(zip(names, np.asarray(values).T, strict=True))
    columns["opacity"] = np.asarray(gaussians.logit_opacities)
    sh = np.zeros((n, 0, 3)) if gaussians.sh is None else np.asarray(gaussians.sh)
    rest = sh.transpose(0, 2, 1).reshape(n, 3 * sh.shape[1])
    rest_names = [f"f_rest_{k}" for k in range(rest.shape[1])]
    columns.update(zip(rest_names, rest.T, strict=True))

    order = [*_POSITION, *_NORMAL, *_DC, *rest_names, "opacity", *_SCALE, *_ROTATION]
    table = np.stack([columns[name] for name in order], axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in order] + ["end_header", ""]
    with atomic.replacing(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def read_ply(path: str | os.PathLike) -> Gaussians:
    """Read one cloud.

    f_rest_* become `sh` (n, k, 3), None where there are none. Raises ValueError, with the name of the file, where it is
    missing, truncated, ASCII, big endian, no .ply at all, or lacks a property of Gaussian clouds.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    with path.open("rb") as f:
        count, dtype = _read_header(path, f)
        data = f.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise ValueError(
            f"{path} is truncated: {count} Gaussians take {count * dtype.itemsize} bytes, found {len(data)}"
        )
    vertices = np.frombuffer(data, dtype)
    rest = [f"f_rest_{k}" for k in range(sum(name.startswith("f_rest_") for name in dtype.names or ()))]
    sh = _gather(vertices, rest).reshape(count, 3, len(rest) // 3).transpose(0, 2, 1) if rest else None
    return Gaussians(
        means=jnp.asarray(_gather(vertices, _POSITION)),
        log_scales=jnp.asarray(_gather(vertices, _SCALE)),
        quats=jnp.asarray(_gather(vertices, _ROTATION)),
        logit_opacities=jnp.asarray(vertices["opacity"].astype(np.float32)),
        colors=jnp.asarray(_gather(vertices, _DC) * np.float32(_SH_0) + np.float32(0.5)),
        sh=None if sh is None else jnp.asarray(sh),
    )


def _gather(vertices: np.ndarray, names: list[str] | tuple[str, ...]) -> np.ndarray:
    return np.stack([vertices[name].astype(np.float32) for name in names], axis=1)


def _read_header(path: Path, f: typing.BinaryIO) -> tuple[int, np.dtype]:
    """Number and layout of the vertices; leaves the file where their data start."""
    if f.readline(16).strip() != b"ply":
        raise ValueError(f"{path} is not a .ply file")
    count, properties, element = None, [], None
    while True:
        line = f.readline(_HEADER_LIMIT)
        words = line.decode("ascii", errors="replace").split()
        if not line.endswith(b"\n") or f.tell() > _HEADER_LIMIT:
            raise ValueError(f"{path} is truncated: its header does not end")
        match words:
            case ["format", encoding, *_] if encoding != "binary_little_endian":
                raise ValueError(f"{path} is a .ply of format {encoding}: only binary_little_endian is read")
            case ["element", "vertex", number] if number.isdigit():
                count, element = int(number), "vertex"
            case ["element", name, *_]:
                if count is None:
                    raise ValueError(f"{path} holds element {name} before its vertices: not a cloud of Gaussians")
                element = name
            case ["property", kind, name] if element == "vertex" and kind in _DTYPES:
                properties.append((name, _DTYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise ValueError(f"{path} has a vertex property that is not a number: {' '.join(words)}")
            case ["end_header"]:
                break
    return count or 0, _checked_layout(path, count, properties)


def _checked_layout(path: Path, count: int | None, properties: list[tuple[str, str]]) -> np.dtype:
    names = [name for name, _ in properties]
    missing = [name for name in (*_POSITION, *_DC, "opacity", *_SCALE, *_ROTATION) if name not in names]
    if count is None or missing:
        raise ValueError(f"{path} is not a cloud of Gaussians: it has no {', '.join(missing) or 'vertices'}")
    rest = {name for name in names if name.startswith("f_rest_")}
    if len(rest) % 3 or rest != {f"f_rest_{k}" for k in range(len(rest))}:
        raise ValueError(f"{path} has {len(rest)} f_rest properties, which are not three channels numbered from 0")
    if len(set(names)) != len(names):
        raise ValueError(f"{path} names a vertex property twice")
    return np.dtype(properties)
