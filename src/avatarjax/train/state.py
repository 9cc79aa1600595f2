"""The training state as a pytree, and the one jitted step that every stage uses."""

from __future__ import annotations

import typing
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

Params = typing.Any
Batch = typing.Any
Metrics = dict[str, Float[Array, ""]]
Loss = Callable[[Params, Key[Array, ""], Batch], tuple[Float[Array, ""], Metrics]]

# Leaves of up to so many entries are optimised together, as one vector.
SMALL = 16_384


@typing.no_type_check
@flax.struct.dataclass
class TrainState:
    """Parameters, their running average (None if none is kept), optimiser state, PRNG key and number of steps done."""

    params: PyTree
    average: PyTree | None
    opt_state: PyTree
    key: Key[Array, ""]
    step: Int[Array, ""]


class Schedule(typing.NamedTuple):
    """How many updates there were, the highest rate, and after how many updates it is reached and left behind."""

    count: Int[Array, ""]
    peak: Float[Array, ""]
    warmup: Int[Array, ""]
    steps: Int[Array, ""]


def optimiser(learning_rate: float, steps: int, *, clip: float = 1.0) -> optax.GradientTransformation:
    """Adam with gradient clipping, a warm-up over the first 3 % of `steps` and a cosine decay to a tenth."""
    adam = optax.scale_by_adam(b2=0.99)
    return together(optax.chain(optax.clip_by_global_norm(clip), adam, scheduled(learning_rate, steps)))


def scheduled(learning_rate: float, steps: int) -> optax.GradientTransformation:
    """The rate of `optimiser`. Its numbers are part of the state, so that a step which was compiled serves others."""
    warmup = max(1, min(200, steps * 3 // 100))
    last = max(steps, warmup + 1)

    def init(params):
        return Schedule(jnp.int32(0), jnp.float32(learning_rate), jnp.int32(warmup), jnp.int32(last))

    def update(gradient, state, params=None):
        done = jnp.clip((state.count - state.warmup) / (state.steps - state.warmup), 0, 1)
        rising = 0.05 + 0.95 * state.count / state.warmup
        share = jnp.where(state.count < state.warmup, rising, 0.1 + 0.45 * (1 + jnp.cos(jnp.pi * done)))
        moves = jax.tree.map(lambda g: -share * state.peak * g, gradient)
        return moves, state._replace(count=optax.safe_increment(state.count))

    return optax.GradientTransformation(init, update)


def together(transform: optax.GradientTransformation) -> optax.GradientTransformation:
    """The transformation of `packed` parameters: for one that treats all entries alike, in a fraction of the programs
    that XLA would compile for each leaf of a network, and with fewer passes over small ones."""

    def update(gradient, state, params=None):
        found, state = transform.update(packed(gradient), state, None if params is None else packed(params))
        return unpacked(found, gradient), state

    return optax.GradientTransformation(lambda params: transform.init(packed(params)), update)


def packed(tree: PyTree) -> list[Array]:
    """The large leaves as they are, and all small ones in one vector. Large ones gain nothing, and are not copied."""
    leaves = jax.tree.leaves(tree)
    small = [leaf.ravel() for leaf in leaves if leaf.size <= SMALL]
    return [*(leaf for leaf in leaves if leaf.size > SMALL), *([jnp.concatenate(small)] if small else [])]


def unpacked(parts: list[Array], like: PyTree) -> PyTree:
    """The tree of which `parts` are the packed leaves, with the shapes and types of another."""
    leaves, structure = jax.tree.flatten(like)
    large, start, found = iter(parts), 0, []
    for leaf in leaves:
        if leaf.size > SMALL:
            found.append(next(large))
        else:
            found.append(parts[-1][start : start + leaf.size].reshape(leaf.shape).astype(leaf.dtype))
            start += leaf.size
    return jax.tree.unflatten(structure, found)


def new_state(
    params: Params, transform: optax.GradientTransformation, key: Key[Array, ""], *, averaged: bool = False
) -> TrainState:
    """A state before its first step. `averaged` keeps an exponential moving average of the parameters."""
    # Steps donate the state: copied, the caller's arrays stay. By way of NumPy nothing is compiled for each shape, and
    # no type is weak, with which the second step would be compiled anew.
    params = jax.device_get(params)
    average = jax.tree.map(jnp.array, params) if averaged else None
    params = jax.tree.map(jnp.array, params)
    return TrainState(params, average, transform.init(params), key, jnp.zeros((), jnp.int32))


def weights(state: TrainState) -> Params:
    """The parameters to use after training: the average where there is one."""
    return state.params if state.average is None else state.average


def make_step(
    loss: Loss,
    transform: optax.GradientTransformation,
    *,
    decay: float = 0.0,
    hold: Callable[[Params, Params, Batch], Params] | None = None,
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """A jitted `(state, batch) -> (state, metrics)` with donated state.

    `loss(params, key, batch)` returns the loss and more metrics; `decay` is that of the average of the weights;
    `hold(new, old, batch)` may put back parameters that must not move: a zero gradient alone does not stop Adam's
    momentum. In the average they are the parameters themselves. The metrics hold the loss and the gradient norm; a
    step whose gradient is not finite changes nothing and counts in `skipped`.
    """

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        key = jax.random.fold_in(state.key, state.step)
        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(state.params, key, batch)
        norm = optax.tree.norm(packed(gradient))
        good = jnp.isfinite(norm)
        updates, opt_state = transform.update(gradient, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        if hold is not None:
            params = hold(params, state.params, batch)
        keep = lambda new, old: jax.tree.map(lambda n, o: jnp.where(good, n, o), new, old)  # noqa: E731
        params, opt_state = keep(params, state.params), keep(opt_state, state.opt_state)
        average = state.average
        if average is not None:
            # A young average follows the weights closely, so that it forgets where they started.
            rate = jnp.minimum(decay, (1.0 + state.step) / (10.0 + state.step))
            moved = jax.tree.map(lambda a, p: rate * a + (1 - rate) * p, average, params)
            # What is held is not averaged: it would go on moving towards the parameters.
            moved = moved if hold is None else hold(moved, params, batch)
            average = keep(moved, average)
        new = TrainState(params, average, opt_state, state.key, state.step + 1)
        return new, {"loss": value, "gradient_norm": norm, "skipped": 1.0 - good, **metrics}

    return jax.jit(step, donate_argnums=0)
