"""LPIPS: how differently two pictures excite a network that has learned to see (Zhang et al. 2018, version 0.1).

Both backbones of the original are here, with their real weights (`avatarjax.metrics.pretrained`): "alex", the usual
choice for reported numbers and fast enough to train with on a CPU, and "vgg", the usual choice for training losses.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.metrics.image import Images, check_images

NAMES = ("alex", "vgg")
SMALLEST = 32  # pixels, below which the deepest features vanish
_PAIRS = 4  # compared at a time

# Means and standard deviations of ImageNet's pixels in [0, 1].
_MEAN = np.array([[[[0.485, 0.456, 0.406]]]], np.float32)
_STD = np.array([[[[0.229, 0.224, 0.225]]]], np.float32)
_POOL = "pool"
# Each layer's stride and padding, features taken after those marked True; `_POOL` halves the picture.
_ALEX = ((4, 2, True), _POOL, (1, 2, True), _POOL, (1, 1, True), (1, 1, True), (1, 1, True))
_VGG_STAGES = (2, 2, 3, 3, 3)
_CONV, _LAST = (1, 1, False), (1, 1, True)
_VGG = tuple(x for n in _VGG_STAGES for x in (*[_CONV] * (n - 1), _LAST, _POOL))[:-1]


@typing.no_type_check
@flax.struct.dataclass
class Network:
    """A backbone's convolutions, kernels (kh, kw, in, out) with biases (out,), and one head (c,) a feature layer."""

    kernels: tuple[Float[Array, "kh kw i o"], ...]
    biases: tuple[Float[Array, "o"], ...]
    heads: tuple[Float[Array, "c"], ...]
    name: str = flax.struct.field(pytree_node=False)


def load(name: str = "alex") -> Network:
    """The trained network. Raises ValueError with the command that fetches the weights where they are missing."""
    if name not in NAMES:
        raise ValueError(f"unknown LPIPS network {name!r}: choose one of {', '.join(NAMES)}")
    # Not above: the package imports this module before `python -m avatarjax.metrics.pretrained` runs that one.
    from avatarjax.metrics import pretrained

    found = pretrained.load(name)
    backbone = found["AlexNet_0" if name == "alex" else "VGG16_0"]
    layers = [backbone[f"Conv_{k}"] for k in range(len(backbone))]
    return Network(
        kernels=tuple(jnp.asarray(x["kernel"]) for x in layers),
        biases=tuple(jnp.asarray(x["bias"]) for x in layers),
        heads=tuple(jnp.asarray(found[f"NetLinLayer_{k}"]["Conv_0"]["kernel"].reshape(-1)) for k in range(5)),
        name=name,
    )


def distance(network: Network, a: Images, b: Images) -> Float[Array, "..."]:
    """LPIPS of images (..., h, w, 3) in [0, 1]: 0 for equal images, about 0.7 for unrelated ones; differentiable.

    `b` may be one image (h, w, 3) that all others are compared with, whose features are then found once. A loss may use
    it under jit, where values are not checked. Raises ValueError for different shapes, other than three channels, sides
    below 32 pixels, and outside jit for NaN and values outside [0, 1]. SMAD C.3; UNICA 4.2.
    """
    if b.shape == a.shape[-3:]:
        check_images(a)
        check_images(b)
    else:
        check_images(a, b)
    if a.shape[-1] != 3 or min(a.shape[-3:-1]) < SMALLEST:
        raise ValueError(f"LPIPS compares images of three channels and {SMALLEST} pixels or more, got {a.shape}")
    return _distance(network, jnp.asarray(a), jnp.asarray(b))


@jax.jit
def _distance(network: Network, a: Array, b: Array) -> Array:
    flat = a.reshape(-1, *a.shape[-3:])
    # A few at a time: the features take some hundred times the memory of their picture.
    if b.ndim == 3:
        known = _features(network, b)
        distances = jax.lax.map(lambda x: _apart(network, _features(network, x), known), flat, batch_size=_PAIRS)
    else:
        pairs = flat, b.reshape(flat.shape)
        distances = jax.lax.map(
            lambda pair: _apart(network, *(_features(network, x) for x in pair)), pairs, batch_size=_PAIRS
        )
    return distances.reshape(a.shape[:-3])


def _apart(network: Network, a: list[Array], b: list[Array]) -> Array:
    # The head weighs channels and does nothing else, so it may come after the mean over places.
    layers = zip(network.heads, a, b, strict=True)
    return sum((jnp.mean((x - y) ** 2, axis=(0, 1)) @ head for head, x, y in layers), jnp.zeros(()))


def _features(network: Network, image: Float[Array, "h w 3"]) -> list[Array]:
    """Features (h', w', c) of five layers, each of unit length in every place."""
    x = (image[None] - _MEAN) / _STD
    taken, layers = [], zip(network.kernels, network.biases, strict=True)
    for layer in _ALEX if network.name == "alex" else _VGG:
        if isinstance(layer, str):
            window = 3 if network.name == "alex" else 2
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, window, window, 1), (1, 2, 2, 1), "VALID")
            continue
        stride, padding, take = layer
        kernel, bias = next(layers)
        x = jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), [(padding, padding)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = jax.nn.relu(x + bias[None, None, None])
        if take:
            taken.append(_unit(x[0]))
    return taken


def _unit(x: Array) -> Array:
    """Vectors along the last axis at length 1; a zero vector stays, and has a gradient of zero instead of NaN."""
    squared = jnp.sum(x * x, axis=-1, keepdims=True)
    some = squared > 0
    return x / (jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0) + 1e-10)
