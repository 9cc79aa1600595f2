"""Canonical Gaussians and their motion, fitted to takes by splatting: the fast path of SMAD's Gaussian initialisation.

The paper gets canonical Gaussians G^c from a deformable radiance field in 12.5 hours (SMAD 3, "Baselines"; Table I).
Here a hull's surface is drawn, moved by a warp that is told the frame, and both are fitted to the pictures. What comes
of it beside G^c are tracks: where every node is in every frame, from which the dynamics are learned.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key, UInt8

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import image, lpips
from avatarjax.nets.functional import Params
from avatarjax.smad import footage
from avatarjax.smad import graph as graphs
from avatarjax.smad import warp as warps
from avatarjax.smad.driving import Pose
from avatarjax.smad.footage import Footage
from avatarjax.smad.graph import Graph
from avatarjax.smad.warp import Warp
from avatarjax.splat import SplatConfig, render
from avatarjax.train import fit, make_step, new_state, weights
from avatarjax.train.state import Metrics

# Colours are learned as logits, which black and white have none of.
_COLOR_MARGIN = 0.01


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """What is fitted, how fast and for how long; all numbers are ours.

    knot: frames from one control value of a node's spline to the next.
    `*_rate` are those of Adam: metres for means, logarithms, quaternions, and logits of opacities and of colours; all
    fall exponentially to `final_rate` of themselves. silhouette, isometry, offset: weights of those losses; isometry
    holds the distances of each Gaussian to so many `neighbours`. scale_range: the least and the largest standard
    deviation, in those of the median Gaussian at the start.
    """

    knot: int = 3
    steps: int = 4000
    frames_per_step: int = 1
    means_rate: float = 4e-4
    log_scales_rate: float = 6e-3
    quats_rate: float = 3e-3
    logit_opacities_rate: float = 2e-2
    colors_rate: float = 1.5e-2
    warp_rate: float = 6e-3
    final_rate: float = 0.05
    silhouette: float = 0.3
    isometry: float = 0.1  # SMAD 3.3
    offset: float = 0.5
    neighbours: int = 6
    scale_range: tuple[float, float] = (0.06, 4.5)

    def __post_init__(self):
        for name in ("knot", "steps", "frames_per_step", "neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: at least 1 is needed")
        if not 0 < self.scale_range[0] < self.scale_range[1]:
            raise ValueError(f"scale_range {self.scale_range} must rise from above 0")


@typing.no_type_check
@flax.struct.dataclass
class Refined:
    """Canonical Gaussians in the body frame of the canonical pose, and how they move through the takes."""

    gaussians: Gaussians
    warp: Warp


class Quality(typing.NamedTuple):
    """How well k held-out frames are drawn, by their numbers among all frames: PSNR in dB of the whole picture over
    black and, the honest number, of the pixels of the mask; SSIM; LPIPS where weights were given."""

    frames: Int[np.ndarray, " k"]
    psnr: Float[np.ndarray, " k"]
    masked_psnr: Float[np.ndarray, " k"]
    ssim: Float[np.ndarray, " k"]
    lpips: Float[np.ndarray, " k"] | None


@typing.no_type_check
@flax.struct.dataclass
class FrameBatch:
    """k frames: their numbers among all (k,), cameras (k,) and pictures (k, h, w, 4), colours multiplied by alpha. What
    is not trained travels along: of the warp, which Gaussians are neighbours (e, 2), and the range (2,) of log-scales.
    """

    warp: Warp
    edges: Int[Array, "e 2"]
    range: Float[Array, "2"]
    frames: Int[Array, " k"]
    cameras: Camera
    rgba: UInt8[Array, "k h w 4"]


def start(takes: Footage, gaussians: Gaussians, graph: Graph, canonical: Pose, knot: int) -> Refined:
    """The Gaussians as they are, on the nodes of a graph that are moved by skinning alone where the takes' poses say
    where joints are, else not at all.

    They lie in the body frame of the canonical pose. Raises ValueError for a pose with another number of joints than
    the takes', and for Gaussians that are fewer than two, not finite or of view-dependent colours.
    """
    if canonical.rotations.shape != takes.poses.rotations.shape[1:]:
        raise ValueError(
            f"the canonical pose has rotations {canonical.rotations.shape}, poses of the takes "
            f"{takes.poses.rotations.shape[1:]}: take it from one of them"
        )
    if len(gaussians) < 2 or not all(np.isfinite(x).all() for x in jax.tree.leaves(gaussians)):
        raise ValueError(f"{len(gaussians)} Gaussians must be two or more, and finite")
    if gaussians.sh is not None:
        raise ValueError("Gaussians of view-dependent colours cannot turn: give them without sh")
    warp = warps.init(graph, gaussians, takes.takes, knot)
    return Refined(gaussians, warp if takes.rig is None else warps.skinned(warp, takes.rig, canonical, takes.poses))


def refine(
    takes: Footage,
    gaussians: Gaussians,
    graph: Graph,
    canonical: Pose,
    config: RefineConfig,
    folder: str | os.PathLike,
    key: Key[Array, ""],
) -> Refined:
    """Fit canonical Gaussians and their motion to all frames that are not held out.

    Checkpoints and metrics go to `folder`, from which an interrupted run goes on; `dropped` there counts what the
    renderer had no room for. Raises ValueError as `start`.
    """
    order_key, step_key = jax.random.split(key)
    begin = start(takes, gaussians, graph, canonical, config.knot)
    frames = np.flatnonzero(~takes.held_out)
    splat = footage.room(takes, lambda frame: _moved(begin, jnp.asarray(frame)))
    middle = float(jnp.median(gaussians.log_scales))
    near = min(config.neighbours, len(gaussians) - 1)
    edges = graphs.build(np.asarray(gaussians.means), near).edges
    fixed = begin.warp, edges, jnp.asarray(middle + np.log(config.scale_range), jnp.float32)
    seed = int(jax.random.bits(order_key))

    def batch_at(step: int) -> FrameBatch:
        chosen = _chosen(frames, config.frames_per_step, seed, step)
        cameras = jax.tree.map(lambda x: x[chosen], takes.cameras)
        return FrameBatch(*fixed, chosen.astype(np.int32), cameras, takes.rgba[chosen])

    transform = optimiser(config)
    state = new_state(_parameters(begin), transform, step_key)
    step = make_step(lambda *a: loss(config, splat, *a), transform, hold=_in_range)
    mark = hashlib.sha256(f"{config} {takes.takes} {splat}".encode())
    for array in (takes.rgba, *jax.tree.leaves((takes.cameras, begin)), jax.random.key_data(key)):
        mark.update(np.ascontiguousarray(array))
    state = fit(step, state, batch_at, config.steps, folder, "refine", fingerprint=mark.hexdigest()[:12])
    return _assemble(weights(state), begin.warp)


def loss(
    config: RefineConfig, splat: SplatConfig, params: Params, key: Key[Array, ""], batch: FrameBatch
) -> tuple[Float[Array, ""], Metrics]:
    """Mean absolute errors of colours and, with their weights, of alphas, mean squared stretch of edges, and the mean
    square of the nodes' offsets in metres.

    A background that is drawn anew for each step stands behind both pictures: what shows it is not opaque. Stretch is
    that of SMAD Eq. 11, against the distances in the canonical pose and in units of their mean: a single camera does
    not see how far away things move, and of all motions that look alike the one that stretches least and stays nearest
    to the skinned surface is taken.
    """
    refined = _assemble(params, batch.warp)
    background = jax.random.uniform(key, (3,))
    rest = lengths(refined.gaussians.means, batch.edges)

    def terms(view):
        frame, camera, rgba = view
        cloud = warps.move(refined.warp, refined.gaussians, frame)
        out = render(cloud, camera, background=background, config=splat)
        stretch = (lengths(cloud.means, batch.edges) - rest) / jnp.mean(rest)
        regular = {"isometry": jnp.mean(stretch**2), "offset": jnp.mean(warps.offsets(refined.warp, frame) ** 2)}
        return footage.missed(out, rgba, background) | regular

    # One frame after the other, with all that is its own: a batch of scatters is slow on a CPU.
    found = jax.lax.map(terms, (batch.frames, batch.cameras, batch.rgba))
    dropped = jnp.sum(found.pop("dropped"))
    means = {name: jnp.mean(values) for name, values in found.items()}
    weighted = [getattr(config, name) * means[name] for name in ("silhouette", "isometry", "offset")]
    return means["photometric"] + sum(weighted), means | {"dropped": dropped}


def at(refined: Refined, take: int, frame: int) -> Gaussians:
    """The Gaussians in the body frame of a frame; raises ValueError where there is no such frame."""
    return _moved(refined, jnp.asarray(warps.index(refined.warp, take, frame)))


def tracks(refined: Refined, take: int) -> Float[Array, "f n 3"]:
    """Where every node is in every frame of a take, each in its body frame, metres."""
    first = warps.index(refined.warp, take, 0)
    return _tracks(refined, jnp.arange(first, first + refined.warp.takes[take]))


def quality(refined: Refined, takes: Footage, perceptual: lpips.Network | None = None) -> Quality:
    """How well each held-out frame with a person in its mask is drawn; raises ValueError where there is none, which is
    so for takes of two frames."""
    frames = np.flatnonzero(takes.held_out & (takes.rgba[..., 3] > 127).any((1, 2)))
    if not len(frames):
        raise ValueError(f"takes of {takes.takes} frames have none to hold out with a person in it: give longer ones")
    splat = footage.room(takes, lambda frame: _moved(refined, jnp.asarray(frame)), frames.tolist(), growth=1)
    found = []
    for frame in frames:
        camera = jax.tree.map(lambda x, k=frame: jnp.asarray(x[k]), takes.cameras)
        drawn = jnp.clip(_drawn(refined, jnp.asarray(frame), camera, splat), 0, 1)
        rgba = jnp.asarray(takes.rgba[frame], jnp.float32) / 255
        truth, inside = rgba[..., :3], (rgba[..., 3:] > 0.5).astype(jnp.float32)
        values = [image.psnr(drawn, truth), image.masked_psnr(drawn, truth, inside), image.ssim(drawn, truth)]
        found.append(values + ([] if perceptual is None else [lpips.distance(perceptual, drawn, truth)]))
    columns = np.asarray(jax.device_get(found), np.float32).T
    return Quality(frames, *columns[:3], None if perceptual is None else columns[3])


def optimiser(config: RefineConfig) -> optax.GradientTransformation:
    """Adam with a rate for each kind of parameter, all of which decay together."""
    names = ("means", "log_scales", "quats", "logit_opacities", "colors", "warp")

    def adam(name):
        rate = optax.exponential_decay(getattr(config, f"{name}_rate"), config.steps, config.final_rate)
        # A pixel is a small part of the mean, so that gradients are tiny: epsilon must be smaller.
        return optax.adam(rate, eps=1e-12)

    return optax.multi_transform({name: adam(name) for name in names}, {name: name for name in names})


def encode(gaussians: Gaussians) -> Params:
    """What is learned of Gaussians: their own numbers, and logits of their colours."""
    colors = jnp.clip(gaussians.colors, _COLOR_MARGIN, 1 - _COLOR_MARGIN)
    return {
        "means": gaussians.means,
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats,
        "logit_opacities": gaussians.logit_opacities,
        "colors": jnp.log(colors / (1 - colors)),
    }


def decode(learned: Params) -> Gaussians:
    """The inverse of `encode`."""
    return Gaussians(**(learned | {"colors": jax.nn.sigmoid(learned["colors"])}))


def _parameters(refined: Refined) -> Params:
    return encode(refined.gaussians) | {"warp": refined.warp.offsets}


def _assemble(params: Params, fixed: Warp) -> Refined:
    """The inverse of `_parameters`, with the parts of the warp that are not trained."""
    learned = {name: value for name, value in params.items() if name != "warp"}
    return Refined(decode(learned), fixed.replace(offsets=params["warp"]))


def _in_range(new: Params, old: Params, batch: FrameBatch) -> Params:
    """A Gaussian without a limit to its size becomes a needle, or a fog before the camera."""
    return new | {"log_scales": jnp.clip(new["log_scales"], batch.range[0], batch.range[1])}


def lengths(points: Float[Array, "n 3"], edges: Int[Array, "e 2"]) -> Float[Array, " e"]:
    """Lengths of edges, differentiable where points coincide."""
    return jnp.sqrt(jnp.sum((points[edges[:, 0]] - points[edges[:, 1]]) ** 2, axis=-1) + 1e-12)


def _chosen(frames: Int[np.ndarray, " f"], count: int, seed: int, step: int) -> Int[np.ndarray, " k"]:
    """The frames of a step: all come once before any comes again, each time in another order."""
    rounds, places = np.divmod(step * count + np.arange(count), len(frames))
    orders = {r: np.random.default_rng((seed, r)).permutation(frames) for r in set(rounds.tolist())}
    return np.array([orders[r][place] for r, place in zip(rounds.tolist(), places, strict=True)])


@jax.jit
def _moved(refined: Refined, frame: Int[Array, ""]) -> Gaussians:
    return warps.move(refined.warp, refined.gaussians, frame)


@jax.jit
def _tracks(refined: Refined, frames: Int[Array, " f"]) -> Float[Array, "f n 3"]:
    return jax.lax.map(lambda frame: warps.nodes(refined.warp, frame), frames)


def _drawn(refined: Refined, frame: Int[Array, ""], camera: Camera, splat: SplatConfig) -> Float[Array, "h w 3"]:
    return render(_moved(refined, frame), camera, config=splat).image
