"""The deformation network (SMAD 3.2, B.2, Tables G and H): poses and recent motion in, changes of each Gaussian out.

A message is one linear layer and a ReLU of [h_i, h_j, x_j - x_i, v_j - v_i, |x_j - x_i|]. The layer is linear, so all
but the distance can be multiplied at the nodes, before anything is gathered:

    m_ij = relu(P_i + Q_j + |x_j - x_i| w),  Q_j = W_j h_j + g_j,  P_i = W_i h_i - g_i + b,  g = W_x x + W_v v.

That is exact, needs a sixteenth of the arithmetic, and sums the messages of all nodes over the columns of the neighbour
table without an array of messages. `PlainDeformer` says the same in the paper's words, as the reference. The paper
counts 519 features and prints eight entries with a constant 1, which would make 520: the 1 is the layer's bias.
"""

from __future__ import annotations

import itertools
import typing

import flax.struct
import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from avatarjax.nets import functional
from avatarjax.nets.functional import Params
from avatarjax.smad import graph as graphs
from avatarjax.smad.config import DeformerConfig
from avatarjax.smad.graph import Graph

# Heads and their widths. Table H has no opacity head; Eq. 8 and the text before Table G have the opacity.
HEADS = {"position": 3, "velocity": 3, "log_scales": 3, "colors": 3, "logit_opacities": 1}
# Ours: an untrained network changes next to nothing, but its heads pass gradients on from the first step.
_HEAD_SCALE = 1e-3


@typing.no_type_check
@flax.struct.dataclass
class Deltas:
    """What the network says of each Gaussian; all are changes, and all are near zero before training.

    position (n, 3), velocity (n, 3): three linear numbers each, in whatever the caller reads them as (offset or
    acceleration). log_scales (n, 3): of standard deviations, so half the paper's log-diagonal covariance. colors
    (n, 3) in (-1, 1): 2 sigmoid - 1, since Table H's sigmoid alone, in (0, 1), could only brighten; it is
    (colors + 1) / 2. logit_opacities (n,).
    """

    position: Float[Array, "n 3"]
    velocity: Float[Array, "n 3"]
    log_scales: Float[Array, "n 3"]
    colors: Float[Array, "n 3"]
    logit_opacities: Float[Array, "n"]


class PoseEmbedding(nnx.Module):
    """A window of body poses as one vector (Table G)."""

    def __init__(self, config: DeformerConfig, *, rngs: nnx.Rngs):
        widths = [config.pose_window * config.pose] + 3 * [config.pose_width]
        self.layers = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in itertools.pairwise(widths)])
        self.norms = nnx.List([nnx.LayerNorm(width, rngs=rngs) for width in widths[1:]])
        self.leave = nnx.Linear(config.pose_width, config.pose_embedding, rngs=rngs)

    def __call__(self, pose: Float[Array, "w p"]) -> Float[Array, "e"]:
        x = pose.reshape(-1)
        for layer, norm in zip(self.layers[:2], self.norms[:2], strict=True):
            x = jax.nn.relu(norm(layer(x)))
        return self.leave(x + jax.nn.relu(self.norms[2](self.layers[2](x))))


class Deformer(nnx.Module):
    """Projection, message passing with weights shared by its iterations, and decoder (Table H), with factored edges."""

    def __init__(self, config: DeformerConfig, *, rngs: nnx.Rngs):
        self.config = config
        hidden, (wide, narrow) = config.hidden, config.decoder
        self.pose = PoseEmbedding(config, rngs=rngs)
        self.project = nnx.Linear(config.node_inputs + config.pose_embedding, hidden, rngs=rngs)
        if config.iterations:
            self.edge = nnx.Linear(config.edge_inputs, config.message, rngs=rngs)
            # Reset gate, update gate, candidate; with two biases, as PyTorch has it, in which the paper was written.
            self.gru_message = nnx.Linear(config.message, 3 * hidden, rngs=rngs)
            self.gru_hidden = nnx.Linear(hidden, 3 * hidden, rngs=rngs)
        self.decode_wide = nnx.Linear(hidden, wide, rngs=rngs)
        self.decode_narrow = nnx.Linear(wide, narrow, rngs=rngs)
        if config.codes:
            self.decode_code = nnx.Linear(config.codes, narrow, use_bias=False, rngs=rngs)
        small = nnx.initializers.normal(_HEAD_SCALE)
        heads = {k: nnx.Linear(narrow, width, kernel_init=small, rngs=rngs) for k, width in HEADS.items()}
        self.heads = nnx.Dict(heads)

    def __call__(
        self,
        graph: Graph,
        pose: Float[Array, "w p"],
        positions: Float[Array, "n 3"],
        velocities: Float[Array, "n v 3"],
        features: Float[Array, "n f"],
        stiffness: Float[Array, "e"] | None,
        codes: Float[Array, "n z"] | None,
    ) -> Deltas:
        hidden = self._project(pose, positions, velocities, features)
        if self.config.iterations:
            weights = self._weights(graph, stiffness, hidden.dtype)
            ends = jnp.concatenate([positions, velocities[:, :1].reshape(len(positions), -1)], axis=1)
            lengths = self._lengths(graph, positions)
            hidden = self._pass_messages(graph, weights, hidden, ends, lengths)
        return self._decode(hidden, codes)

    def _project(self, pose, positions, velocities, features) -> Float[Array, "n h"]:
        """Layer 0. The embedding is the same for all nodes: its part of the product is taken once, not for each."""
        own, shared = jnp.split(self.project.kernel[...], [self.config.node_inputs])
        inputs = jnp.concatenate([positions, velocities.reshape(len(positions), -1), features], axis=1)
        return jax.nn.relu(inputs @ own + (self.pose(pose) @ shared + jnp.asarray(self.project.bias))[None])

    def _weights(self, graph: Graph, stiffness, dtype) -> Float[Array, "n d"]:
        """What each message counts for in its receiver's sum; 0 on padding."""
        if self.config.aggregation == "mean":
            weights = graph.mask / graph.degree.astype(dtype)[:, None]
        else:
            weights = graph.adjacency.astype(dtype)
        return weights if stiffness is None else weights * stiffness[graph.edge_ids]

    def _lengths(self, graph: Graph, positions) -> list[Float[Array, "n d"]]:
        """The features of an edge that are not linear in its ends."""
        if not self.config.edge_features:
            return []
        distance = graphs.distances(graph, positions)
        return [distance, distance - graph.lengths] if self.config.strain else [distance]

    def _pass_messages(self, graph, weights, hidden, ends, lengths) -> Float[Array, "n h"]:
        """Layers 1 to 9, with what does not change between iterations computed once."""
        size, width = self.config.hidden, self.config.message
        of_receiver, of_sender, of_geometry = jnp.split(self.edge.kernel[...], [size, 2 * size])
        # One product of a node's state for its part as receiver, for that as sender, and for its gates.
        fused = jnp.concatenate([of_receiver, of_sender, self.gru_hidden.kernel[...]], axis=1)
        bias = jnp.asarray(self.edge.bias)
        bias = jnp.concatenate([bias, jnp.zeros_like(bias), jnp.asarray(self.gru_hidden.bias)])
        shift = jnp.zeros((1, width), hidden.dtype)
        if self.config.edge_features:
            of_ends, of_geometry = jnp.split(of_geometry, [ends.shape[1]])
            shift = ends @ of_ends
        columns = graph.neighbours.T, weights.T, [length.T for length in lengths]
        for _ in range(self.config.iterations):
            receiver, sender, gates = jnp.split(hidden @ fused + bias[None], [width, 2 * width], axis=1)
            message = _sum_messages(receiver - shift, sender + shift, of_geometry, columns)
            hidden = _gated(hidden, self.gru_message(message), gates)
        return hidden

    def _decode(self, hidden, codes) -> Deltas:
        """Layers 10 to 15. A latent code enters before the last ReLU, so that look depends on code and state together
        (Eq. 8, D(z_i, h_i)); motion is decoded without it (Eq. 7)."""
        narrow = self.decode_narrow(jax.nn.relu(self.decode_wide(hidden)))
        motion = jax.nn.relu(narrow)
        look = motion if codes is None else jax.nn.relu(narrow + self.decode_code(codes))
        out = {k: self.heads[k](motion if k in ("position", "velocity") else look) for k in HEADS}
        # 2 sigmoid(x) - 1, without losing the digits of small changes.
        out["colors"] = jnp.tanh(out["colors"] / 2)
        return Deltas(**{**out, "logit_opacities": out["logit_opacities"][:, 0]})


class PlainDeformer(Deformer):
    """The same network with edge features written out as B.2 prints them, an array (n, d, 519): slow and obvious."""

    def _pass_messages(self, graph, weights, hidden, ends, lengths) -> Float[Array, "n h"]:
        def both(x):
            sent = x[graph.neighbours]
            return jnp.broadcast_to(x[:, None], sent.shape), sent

        for _ in range(self.config.iterations):
            features = list(both(hidden))
            if self.config.edge_features:
                here, there = both(ends)
                features += [there - here, *(length[..., None] for length in lengths)]
            messages = jax.nn.relu(self.edge(jnp.concatenate(features, axis=-1)))
            message = jnp.sum(weights[..., None] * messages, axis=1)
            hidden = _gated(hidden, self.gru_message(message), self.gru_hidden(hidden))
        return hidden


def init(config: DeformerConfig, graph: Graph, key: Key[Array, ""]) -> Params:
    """Fresh parameters: the network's, a latent code (n, z) for each node, a log-stiffness (e,) for each edge."""
    network_key, code_key = jax.random.split(key)
    params = {"network": functional.init(Deformer, config, network_key)}
    if config.codes:
        params["codes"] = 0.1 * jax.random.normal(code_key, (len(graph.positions), config.codes))
    if config.adaptive_stiffness:
        params["log_stiffness"] = jnp.zeros(len(graph.edges))
    return params


def embed(config: DeformerConfig, params: Params, pose: Float[Array, "w p"]) -> Float[Array, "e"]:
    """The embedding of a window of poses alone (Table G), as `deform` uses it."""
    return functional.bind(Deformer, config, params["network"]).pose(pose)


def deform(
    config: DeformerConfig,
    params: Params,
    graph: Graph,
    pose: Float[Array, "w p"],
    positions: Float[Array, "n 3"],
    velocities: Float[Array, "n v 3"],
    features: Float[Array, "n f"] | None = None,
    network: type[Deformer] = Deformer,
) -> Deltas:
    """One step of the network: changes of each Gaussian.

    pose (w, p): the last w poses, newest first; velocities (n, v, 3) newest first, metres a second; features (n, f):
    further numbers of each node. In which frame of reference, and in which units, is the caller's to say. Raises
    ValueError where a shape is not what `config` says.
    """
    count = len(graph.positions)
    features = jnp.zeros((count, 0), positions.dtype) if features is None else features
    for name, found, expected in (
        ("pose", pose.shape, (config.pose_window, config.pose)),
        ("positions", positions.shape, (count, 3)),
        ("velocities", velocities.shape, (count, config.velocities, 3)),
        ("features", features.shape, (count, config.node_features)),
    ):
        if found != expected:
            raise ValueError(f"{name} {found} must be {expected} for this graph and configuration")
    stiffness = jnp.exp(params["log_stiffness"]) if config.adaptive_stiffness else None
    codes = params["codes"] if config.codes else None
    net = functional.bind(network, config, params["network"])
    return net(graph, pose, positions, velocities, features, stiffness, codes)


def _sum_messages(receiver, sender, of_lengths, columns) -> Float[Array, "n m"]:
    """Weighted sums of messages over the columns of the neighbour table: (n, m) arrays and never (n, d, m).

    receiver, sender (n, m): what the ends contribute to a message; of_lengths (l, m): the kernel of the l lengths of an
    edge; columns: senders (d, n), weights (d, n), lengths (d, n) each.
    """

    def column(total, inputs):
        ids, weight, lengths = inputs
        message = receiver + sender[ids]
        for length, kernel in zip(lengths, of_lengths, strict=True):
            message = message + length[:, None] * kernel[None]
        return total + weight[:, None] * jax.nn.relu(message), None

    # Backwards it gathers again, which takes less time than keeping a column's masks and messages, and half the memory.
    column = jax.checkpoint(column, prevent_cse=False)
    return jax.lax.scan(column, jnp.zeros_like(receiver), columns)[0]


def _gated(hidden, by_message, by_hidden) -> Float[Array, "n h"]:
    """A gated recurrent unit (Cho et al. 2014) from its two products (n, 3h): the reset gate acts after the product."""
    r, z, c = jnp.split(by_message, 3, axis=1)
    s, y, d = jnp.split(by_hidden, 3, axis=1)
    update = jax.nn.sigmoid(z + y)
    return (1 - update) * jnp.tanh(c + jax.nn.sigmoid(r + s) * d) + update * hidden
