"""Everybody's own data: mesh sequences, glTF animations, public position maps, Gaussian scenes, monocular videos."""

from avatarjax.data.importers.gltf_animation import SkeletonAnimation, load_gltf_animation
from avatarjax.data.importers.mesh_sequence import MeshSequence, load_mesh_sequence
from avatarjax.data.importers.monocular import MonocularVideo, Poses, load_monocular, write_monocular
from avatarjax.data.importers.position_maps import PositionMapSequence, load_position_maps
from avatarjax.data.importers.scenes import GaussianScene, load_gaussian_scene

__all__ = [
    "GaussianScene",
    "MeshSequence",
    "MonocularVideo",
    "Poses",
    "PositionMapSequence",
    "SkeletonAnimation",
    "load_gaussian_scene",
    "load_gltf_animation",
    "load_mesh_sequence",
    "load_monocular",
    "load_position_maps",
    "write_monocular",
]
