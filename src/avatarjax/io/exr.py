"""Float images as OpenEXR through OpenImageIO, and 8-bit images as PNG, without any colour conversion."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from avatarjax.io import atomic


def read_exr(path: str | os.PathLike) -> Float[np.ndarray, "h w c"]:
    """The float32 pixels of an EXR file; ValueError that names a missing or unreadable file."""
    return _read(path, "float")


def write_exr(path: str | os.PathLike, pixels: Float[np.ndarray, "h w c"]) -> None:
    """Write float32 pixels losslessly (zip compression), atomically."""
    _write(path, np.asarray(pixels, np.float32), {"compression": "zip"})


def read_png(path: str | os.PathLike) -> UInt8[np.ndarray, "h w c"]:
    """The 8-bit pixels of a PNG file, alpha straight; ValueError that names a missing or unreadable file."""
    return _read(path, "uint8")


def write_png(path: str | os.PathLike, pixels: UInt8[np.ndarray, "h w c"]) -> None:
    """Write 8-bit pixels with 1, 3 or 4 channels (straight alpha), atomically."""
    _write(path, np.ascontiguousarray(pixels), {"oiio:UnassociatedAlpha": 1})


def _read(path: str | os.PathLike, dtype: str) -> np.ndarray:
    import OpenImageIO as oiio

    if not Path(path).is_file():
        raise ValueError(f"{path} does not exist")
    source = oiio.ImageInput.open(str(path), _config({"oiio:UnassociatedAlpha": 1}))
    pixels = source.read_image(dtype) if source else None
    if source:
        source.close()
    if pixels is None:
        raise ValueError(f"{path} cannot be read as an image: {oiio.geterror() or 'damaged file'}")
    return pixels if pixels.ndim == 3 else pixels[..., None]


def _write(path: str | os.PathLike, pixels: np.ndarray, attributes: dict[str, str | int]) -> None:
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, str(pixels.dtype).replace("float32", "float"))
    for name, value in attributes.items():
        spec.attribute(name, value)
    with atomic.replacing(path) as temporary:
        target = oiio.ImageOutput.create(str(temporary))
        if not (target and target.open(str(temporary), spec) and target.write_image(pixels)):
            raise OSError(f"cannot write {path}: {oiio.geterror()}")
        target.close()


def _config(attributes: dict[str, str | int]):
    import OpenImageIO as oiio

    spec = oiio.ImageSpec()
    for name, value in attributes.items():
        spec.attribute(name, value)
    return spec
