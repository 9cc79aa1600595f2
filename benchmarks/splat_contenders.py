"""What benchmarks/splat.py compares: the kernel, its reference, the old prototype, and peers that are installed."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import typing

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import Camera, Gaussians
from avatarjax.splat import SplatConfig, render, required_capacity
from avatarjax.splat.reference import render_reference
from benchmarks import scenes, splat_prototype
from benchmarks.timing import BACKWARD, FORWARD, Contender, Unavailable

# The naive renderer holds a dozen arrays of this many float32 numbers.
_NAIVE_MAX = 200_000_000


@dataclasses.dataclass(frozen=True)
class Scene:
    """A "body" or "needle" cloud of n Gaussians (see scenes.py), and an image of `size` pixels a side."""

    cloud: str
    n: int
    size: int

    def make(self) -> tuple[Gaussians, Camera]:
        clouds = {"body": scenes.body_cloud, "needle": scenes.needle_cloud}
        return clouds[self.cloud](self.n), scenes.body_camera(self.size)

    def weights(self) -> np.ndarray:
        """(size, size, 3) fixed random weights: the loss is sum(image * weights) + sum(alpha)."""
        return np.random.default_rng(0).normal(size=(self.size, self.size, 3)).astype(np.float32)

    def __str__(self) -> str:
        return f"{self.cloud}, {self.n:,} Gaussians, {self.size}x{self.size} pixels"


def ours(scene: Scene, config: SplatConfig = SplatConfig()) -> Contender:
    """`avatarjax.render` with room for just this scene, on as many devices as `config` has shards."""
    if config.shards > 1:
        # Only before JAX starts: a process takes no more than one configuration.
        jax.config.update("jax_num_cpu_devices", config.shards)
    cloud, camera = scene.make()
    weights = jnp.asarray(scene.weights())
    config = dataclasses.replace(config, capacity=required_capacity(cloud, camera, config))
    if config.shards > 1:
        mesh = jax.make_mesh((config.shards,), ("shards",), axis_types=(jax.sharding.AxisType.Auto,))
        cloud = jax.device_put(cloud, jax.NamedSharding(mesh, jax.P("shards")))
        camera, weights = jax.device_put((camera, weights), jax.NamedSharding(mesh, jax.P()))

    @jax.jit
    def draw(cloud, camera):
        output = render(cloud, camera, config=config)
        return output, {"intersections": output.info.total, "dropped": output.info.dropped}

    return _jax_contender(draw, cloud, camera, weights)


def prototype(scene: Scene) -> Contender:
    """The frozen prototype with the lanes that were its fastest at each size.

    It takes scales and opacities themselves, so it is spared exp, sigmoid and their gradients.
    """
    cloud, camera = scene.make()
    lanes = {64: 16, 128: 32}.get(scene.size, 128)
    # Five a Gaussian as it was measured, which is too little only for tiny clouds.
    capacity = max(5 * scene.n, 2**13)

    @jax.jit
    def draw(arrays, camera):
        matrices, size = (camera.world_to_camera, camera.intrinsics), (camera.width, camera.height)
        image, alpha, (total, dropped) = splat_prototype.rasterize(
            *arrays, *matrices, *size, capacity=capacity, forward=(lanes, 16), backward=(lanes, 8)
        )
        return _Drawn(image, alpha), {"intersections": total, "dropped": dropped}

    arrays = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.colors)
    return _jax_contender(draw, arrays, camera, jnp.asarray(scene.weights()))


def naive(scene: Scene) -> Contender:
    """`render_reference` in float32: every Gaussian at every pixel."""
    if scene.n * scene.size**2 > _NAIVE_MAX:
        raise Unavailable("too large")
    draw = jax.jit(lambda cloud, camera: (render_reference(cloud, camera), {}))
    return _jax_contender(draw, *scene.make(), jnp.asarray(scene.weights()))


def torch(scene: Scene) -> Contender:
    """Plain PyTorch, splat_torch.py."""
    _require("torch")
    from benchmarks import splat_torch

    renderer = splat_torch.Renderer(*scene.make())
    weights = scene.weights()
    return Contender(renderer.image, lambda: renderer.gradient(weights), image=lambda: renderer.image().numpy())


def mitsuba(scene: Scene) -> Contender:
    """Mitsuba 3, splat_mitsuba.py. Its loss is without the alpha; its search structure is built before it is timed."""
    _require("mitsuba")
    try:
        from benchmarks import splat_mitsuba
    except ImportError as error:
        raise Unavailable(f"does not start: {error}") from None

    renderer = splat_mitsuba.Renderer(*scene.make())
    weights = scene.weights()

    def compile_pass(which):
        renderer.image() if which == FORWARD else renderer.gradient(weights)
        splat_mitsuba.release()

    return Contender(
        forward=renderer.image,
        backward=lambda: renderer.gradient(weights),
        image=lambda: np.array(renderer.image()),
        compile=compile_pass,
    )


def _require(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise Unavailable("not installed")


class _Drawn(typing.NamedTuple):
    image: jax.Array
    alpha: jax.Array


def _jax_contender(draw: typing.Any, cloud: typing.Any, camera: Camera, weights: jax.Array) -> Contender:
    """Of a jitted `draw(cloud, camera)`, which returns image and alpha, and counts by name."""

    def loss(cloud, camera, weights):
        drawn, _ = draw(cloud, camera)
        return jnp.sum(drawn.image * weights) + jnp.sum(drawn.alpha)

    @functools.cache
    def compiled(which):
        if which == FORWARD:
            return draw.lower(cloud, camera).compile()
        return jax.jit(jax.value_and_grad(loss)).lower(cloud, camera, weights).compile()

    def forward():
        return jax.block_until_ready(compiled(FORWARD)(cloud, camera))

    return Contender(
        forward=forward,
        backward=lambda: jax.block_until_ready(compiled(BACKWARD)(cloud, camera, weights)),
        image=lambda: np.asarray(forward()[0].image),
        counts=lambda: {name: int(count) for name, count in forward()[1].items()},
        compile=compiled,
    )
