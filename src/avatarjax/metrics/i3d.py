"""The Inflated 3D ConvNet that the Fréchet video distance looks through: RGB stream, trained on Kinetics-400.

Carreira & Zisserman, "Quo Vadis, Action Recognition? A New Model and the Kinetics Dataset", 2017, as published on
TF-Hub (`deepmind/i3d-kinetics-400/1`). A kernel over (t, h, w) is kept as one over (h, w) whose input channels are the
t frames side by side: XLA's convolutions over three axes are slow on CPU, those over two are not, and the sum is the
same.
"""

from __future__ import annotations

import typing

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from avatarjax.metrics import pretrained

SIZE = 224
MIN_FRAMES = 9  # Fewer leave the last pooling, over two frames after a stride of eight, nothing to pool.
CLASSES = 400
_UNITS = {"1a": "Conv3d_1a_7x7", "2b": "Conv3d_2b_1x1", "2c": "Conv3d_2c_3x3"}
_MIXED = ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c")
_POOLED_BEFORE = {"4b": ((3, 3, 3), (2, 2, 2)), "5b": ((2, 2, 2), (2, 2, 2))}
_EPSILON = 1e-3
# By default GPUs round the factors of products to ten bits.
_PRECISION = lax.Precision.HIGHEST


def load() -> dict[str, typing.Any]:
    """The published weights, folded. Raises ValueError, with the command that fetches them, where they are not here."""
    return fold(pretrained.load("i3d"))


def fold(weights: dict[str, typing.Any]) -> dict[str, typing.Any]:
    """Parameters for `logits` from nested dicts {"params", "batch_stats"} of NumPy arrays, named as on TF-Hub.

    Batch normalisation, which has no scale, goes into kernels and biases. Every unit is {"kernel", "bias"}; a mixed
    block is {"entry", "1", "2", "3"}, where `entry` joins the 1x1x1 units in front of branches 0, 1 and 2.
    """
    params: dict[str, typing.Any] = {name: _unit(weights, unit) for name, unit in _UNITS.items()}
    for name in _MIXED:
        entries = [_unit(weights, f"Mixed_{name}", f"Branch_{k}/Conv3d_0a_1x1") for k in range(3)]
        params[name] = {
            "entry": {key: np.concatenate([entry[key] for entry in entries], axis=-1) for key in ("kernel", "bias")},
            "1": _unit(weights, f"Mixed_{name}", "Branch_1/Conv3d_0b_3x3"),
            "2": _unit(weights, f"Mixed_{name}", "Branch_2/Conv3d_0b_3x3"),
            "3": _unit(weights, f"Mixed_{name}", "Branch_3/Conv3d_0b_1x1"),
        }
    last = weights["params"]["Logits/Conv3d_0c_1x1"]["Conv_0"]
    params["logits"] = {"kernel": frames_to_channels(last["kernel"]), "bias": last["bias"].reshape(-1)}
    return params


def logits(params: dict[str, typing.Any], clips: Float[Array, "b t h w 3"]) -> Float[Array, "b 400"]:
    """Scores (b, 400) of the classes of Kinetics for RGB clips (b, t, 224, 224, 3) in [-1, 1], means over time.

    Raises ValueError for frames of another size, or fewer than 9 of them. Jit it; values are not checked.
    """
    if clips.shape[2:4] != (SIZE, SIZE) or clips.shape[1] < MIN_FRAMES:
        raise ValueError(f"I3D takes clips (b, {MIN_FRAMES} or more, {SIZE}, {SIZE}, 3), got {clips.shape}")
    x = _relu_unit(params["1a"], clips, taps=7, stride=2)
    x = max_pool(x, (1, 3, 3), (1, 2, 2))
    x = _relu_unit(params["2b"], x)
    x = _relu_unit(params["2c"], x, taps=3)
    x = max_pool(x, (1, 3, 3), (1, 2, 2))
    for name in _MIXED:
        if name in _POOLED_BEFORE:
            x = max_pool(x, *_POOLED_BEFORE[name])
        x = _mixed(params[name], x)
    x = jnp.mean(x, axis=(2, 3))
    # Two frames at a time, then all: frames at the ends count half.
    x = jnp.mean((x[:, :-1] + x[:, 1:]) / 2, axis=1)
    return jnp.matmul(x, params["logits"]["kernel"][0, 0], precision=_PRECISION) + params["logits"]["bias"][None]


def frames_to_channels(kernel: Float[np.ndarray, "t h w i o"]) -> Float[np.ndarray, "h w j o"]:
    """A kernel over (t, h, w) as the kernel over (h, w) that `conv` takes, with input channels j = t * i."""
    t, h, w, i, o = kernel.shape
    return np.ascontiguousarray(kernel.transpose(1, 2, 0, 3, 4)).reshape(h, w, t * i, o)


def conv(
    x: Float[Array, "b t h w i"], kernel: Float[Array, "p q j o"], *, taps: int, stride: int = 1
) -> Float[Array, "b t2 h2 w2 o"]:
    """Convolution over time, height and width, padded as TensorFlow's SAME; `kernel` made by `frames_to_channels`.

    `taps` is its extent in time, j = taps * i; one stride serves the three axes.
    """
    b, t, h, w, _ = x.shape
    frames, low, high = _same(t, taps, stride)
    x = jnp.pad(x, ((0, 0), (low, high), (0, 0), (0, 0), (0, 0)))
    last = (frames - 1) * stride + 1
    side_by_side = jnp.concatenate([x[:, k : k + last : stride] for k in range(taps)], axis=-1)
    out = lax.conv_general_dilated(
        side_by_side.reshape(b * frames, h, w, -1),
        kernel,
        (stride, stride),
        "SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=_PRECISION,
    )
    return out.reshape(b, frames, *out.shape[1:])


def max_pool(
    x: Float[Array, "b t h w c"], window: tuple[int, int, int], stride: tuple[int, int, int]
) -> Float[Array, "b t2 h2 w2 c"]:
    """Maximum over windows (t, h, w), padded as TensorFlow's SAME: outside the clip nothing competes."""
    # An axis at a time: the maximum is the same, and XLA's window over all three is 3 to 20 times as slow on CPU.
    for axis, (size, step) in enumerate(zip(window, stride, strict=True), start=1):
        if size > 1 or step > 1:
            one = [1] * 5
            sizes, steps = [*one[:axis], size, *one[axis + 1 :]], [*one[:axis], step, *one[axis + 1 :]]
            x = lax.reduce_window(x, -jnp.inf, lax.max, sizes, steps, "SAME")
    return x


def _mixed(params: dict[str, typing.Any], x: Float[Array, "b t h w i"]) -> Float[Array, "b t h w o"]:
    """Inception block: 1x1x1, 1x1x1 then 3x3x3 twice, and pooling then 1x1x1, side by side."""
    first, second = (params[k]["kernel"].shape[2] // 3 for k in "12")
    entry = _relu_unit(params["entry"], x)
    ends = entry.shape[-1] - first - second, entry.shape[-1] - second
    straight, one, two = jnp.split(entry, ends, axis=-1)
    pooled = max_pool(x, (3, 3, 3), (1, 1, 1))
    return jnp.concatenate(
        [
            straight,
            _relu_unit(params["1"], one, taps=3),
            _relu_unit(params["2"], two, taps=3),
            _relu_unit(params["3"], pooled),
        ],
        axis=-1,
    )


def _relu_unit(params: dict[str, typing.Any], x: Array, *, taps: int = 1, stride: int = 1) -> Array:
    kernel = params["kernel"]
    if kernel.shape[:2] == (1, 1):
        x = jnp.matmul(x, kernel[0, 0], precision=_PRECISION)
    else:
        x = conv(x, kernel, taps=taps, stride=stride)
    return jnp.maximum(x + params["bias"].reshape(1, 1, 1, 1, -1), 0)


def _same(length: int, window: int, stride: int) -> tuple[int, int, int]:
    """Number of windows along an axis under SAME padding, and the padding before and after."""
    count = -(-length // stride)
    lacking = max((count - 1) * stride + window - length, 0)
    return count, lacking // 2, lacking - lacking // 2


def _unit(weights: dict[str, typing.Any], *names: str) -> dict[str, np.ndarray]:
    """Kernel and bias of a convolution with the batch normalisation behind it."""
    found, statistics = weights["params"], weights["batch_stats"]
    for name in names:
        found, statistics = found[name], statistics[name]
    norm = statistics["BatchNorm_0"]
    scale = 1 / np.sqrt(norm["var"].reshape(-1).astype(np.float64) + _EPSILON)
    kernel = found["Conv_0"]["kernel"] * scale
    bias = found["BatchNorm_0"]["bias"].reshape(-1) - norm["mean"].reshape(-1) * scale
    return {"kernel": frames_to_channels(kernel.astype(np.float32)), "bias": bias.astype(np.float32)}
