"""Position maps: the six-view atlas, encoding and decoding, upscaling, principal components, public files."""

from avatarjax.posmap.atlas import Atlas, Window, build_atlas, windows
from avatarjax.posmap.box import Box, bounding_box, into_box
from avatarjax.posmap.codec import (
    denormalize,
    encode,
    from_map,
    heading,
    normalize,
    normalize_group,
    root,
    to_map,
)
from avatarjax.posmap.neighbours import around, convolve, neighbours
from avatarjax.posmap.surface import Frames, Tangents, frames, tangents, turns
from avatarjax.posmap.upscale import Upscaler, build_upscaler, upscale

__all__ = [
    "Atlas",
    "Box",
    "Frames",
    "Tangents",
    "Upscaler",
    "Window",
    "around",
    "bounding_box",
    "build_atlas",
    "build_upscaler",
    "convolve",
    "denormalize",
    "encode",
    "frames",
    "from_map",
    "heading",
    "into_box",
    "neighbours",
    "normalize",
    "normalize_group",
    "root",
    "tangents",
    "to_map",
    "turns",
    "upscale",
    "windows",
]
