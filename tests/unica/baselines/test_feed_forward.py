"""The feed-forward pipeline: what the fourth frame sees, what gets a gradient, and that it answers keys."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, unica
from avatarjax.nets import functional
from avatarjax.nets.functional import bind
from avatarjax.unica import batches, evaluate, forecast
from avatarjax.unica.baselines import feed_forward, vq
from avatarjax.unica.baselines.feed_forward import FeedForwardDynamics, Transformer
from avatarjax.unica.config import preset
from avatarjax.unica.denoiser import Denoiser
from avatarjax.unica.vae import VAE
from tests.parameters import random_params
from tests.unica.baselines.conftest import SIZES

ACTIONS = np.array([1, 3, 0], np.int32)


@pytest.fixture(scope="module")
def dynamics(tiny_data, latent_dynamics):
    """Parameters at random, entries where the encoder's vectors lie."""
    made = FeedForwardDynamics(
        vae=random_params(VAE, SIZES.vae, scale=0.2),
        codebook=jnp.zeros((SIZES.codes, 6)),
        transformer=random_params(Transformer, SIZES, seed=1, scale=0.5),
        map_mean=latent_dynamics.map_mean,
        map_scale=latent_dynamics.map_scale,
        code_mean=jnp.linspace(-0.1, 0.1, 6),
        code_scale=jnp.asarray(0.3),
        config=SIZES,
    )
    frames = groups_of(tiny_data, np.arange(0, 1000, 50))[0][:, 3]
    vectors = jax.jit(feed_forward.encode)(tiny_data.atlas, made, frames).reshape(-1, 6)
    return made.replace(codebook=vectors[:: len(vectors) // SIZES.codes][: SIZES.codes])


def groups_of(tiny_data, chosen):
    windows = batches.windows(tiny_data.train, 4, (0, 25))
    return tuple(jnp.asarray(x) for x in windows.groups(chosen, float(tiny_data.atlas.scale)))


@pytest.fixture(scope="module")
def groups(tiny_data):
    return groups_of(tiny_data, np.array([5, 300]))


@pytest.fixture(scope="module")
def avatar(avatars, dynamics):
    return avatars["unet"].replace(dynamics=dynamics, pca=None)


class TestTransformer:
    @pytest.fixture
    def context(self):
        return jax.random.normal(jax.random.key(4), (2, 3, 8, 8, 6))

    @pytest.fixture
    def params(self):
        return random_params(Transformer, SIZES, seed=1, scale=0.5)

    @staticmethod
    def run(config, params, context, action):
        return jax.jit(lambda p, c, a: bind(Transformer, config, p)(c, a))(params, context, jnp.asarray(action))

    def test_without_attention_the_fourth_frame_is_its_place_its_turn_and_the_action(self, context):
        """Its content is zero: nothing else reaches it."""
        config = dataclasses.replace(SIZES, depth=0)
        params = random_params(Transformer, config)
        found = self.run(config, params, context, [1, 4])
        tables = [np.asarray(params[name]["embedding"], np.float64) for name in ("frame_table", "action_table")]
        x = np.asarray(params["place_table"]["embedding"]) + np.asarray(params["enter"]["bias"]) + tables[0][3]
        x = x[None] + tables[1][[1, 4]][:, None]
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
        x = x * np.asarray(params["norm"]["scale"]) + np.asarray(params["norm"]["bias"])
        x = x @ np.asarray(params["leave"]["kernel"]) + np.asarray(params["leave"]["bias"])
        np.testing.assert_allclose(found, x.reshape(2, 8, 8, 6), atol=1e-4)

    @pytest.mark.parametrize("frame", range(3))
    def test_every_frame_of_the_context_reaches_every_place(self, params, context, frame):
        before = self.run(SIZES, params, context, [1, 1])
        after = self.run(SIZES, params, context.at[0, frame, 2, 3].add(3.0), [1, 1])
        assert (jnp.abs(after - before)[0].max(-1) > 1e-6).all()
        np.testing.assert_allclose(after[1], before[1], atol=1e-5)

    def test_the_action_matters(self, params, context):
        before, after = (self.run(SIZES, params, context, a) for a in ([1, 2], [1, 3]))
        assert jnp.abs(after - before)[1].max() > 1e-3
        np.testing.assert_allclose(after[0], before[0], atol=1e-5)


class TestLosses:
    def test_the_vqvae_loss_is_its_three_terms(self, tiny_data, dynamics, groups):
        texels = groups[0][:, 3]
        loss, metrics = jax.jit(feed_forward.vqvae_loss)(tiny_data.atlas, dynamics, texels)
        vectors = jax.jit(feed_forward.encode)(tiny_data.atlas, dynamics, texels)
        back = jax.jit(feed_forward.reconstruct)(tiny_data.atlas, dynamics, texels)
        apart = vectors - dynamics.codebook[vq.nearest(dynamics.codebook, vectors)]
        squared = float(jnp.mean((back - texels) ** 2))
        expected = squared / float(dynamics.map_scale) ** 2 + 1.25 * float(jnp.mean(apart**2))
        assert float(loss) == pytest.approx(expected, rel=1e-3)
        assert float(metrics["rmse"]) == pytest.approx(np.sqrt(squared), rel=1e-3)

    def test_encoder_decoder_and_the_entries_in_use_learn(self, tiny_data, dynamics, groups):
        texels = groups[0][:, 3]
        used = np.unique(jax.jit(feed_forward.codes)(tiny_data.atlas, dynamics, texels))

        @jax.jit
        def gradient(dynamics):
            def loss(params):
                return feed_forward.vqvae_loss(tiny_data.atlas, dynamics.replace(**params), texels)[0]

            return jax.grad(loss)({"vae": dynamics.vae, "codebook": dynamics.codebook})

        found = gradient(dynamics)
        for part in ("enter", "down", "to_moments", "from_latent", "leave"):
            assert max(float(jnp.abs(g).max()) for g in jax.tree.leaves(found["vae"][part])) > 0, part
        np.testing.assert_array_equal(np.flatnonzero(np.abs(found["codebook"]).max(-1)), used)

    def test_without_commitment_the_encoder_still_learns_from_the_picture(self, tiny_data, dynamics, groups):
        free = dynamics.replace(config=dataclasses.replace(SIZES, commitment=0.0))
        loss = lambda d, vae: feed_forward.vqvae_loss(tiny_data.atlas, d.replace(vae=vae), groups[0][:, 3])[0]  # noqa: E731
        found = jax.jit(jax.grad(loss, argnums=1))(free, free.vae)
        assert float(jnp.abs(found["enter"]["kernel"]).max()) > 0

    def test_only_the_loss_knows_the_fourth_frame(self, tiny_data, dynamics, groups, monkeypatch):
        """The transformer gets codes of three frames, and the loss is the distance to those of the fourth."""
        seen = []

        def told(dynamics, context, action):
            seen.append(context)
            return jnp.zeros_like(context[:, 0])

        monkeypatch.setattr(feed_forward, "_transform", told)
        loss = feed_forward.prediction_loss(tiny_data.atlas, dynamics, *groups)
        tokens = [
            (dynamics.codebook[feed_forward.codes(tiny_data.atlas, dynamics, x)] - dynamics.code_mean[None, None, None])
            / dynamics.code_scale
            for x in groups[0].swapaxes(0, 1)
        ]
        np.testing.assert_allclose(seen[0], np.stack(tokens[:3], 1), atol=1e-4)
        assert float(loss) == pytest.approx(float(jnp.mean(tokens[3] ** 2)), rel=1e-4)


@jax.jit
def roll(avatar, state):
    return unica.rollout(avatar, state, jnp.asarray(ACTIONS), gaussians=False)[1]


@pytest.fixture(scope="module")
def rolled(avatar):
    return roll(avatar, unica.reset(avatar, jax.random.key(0)))


class TestRollout:
    def test_it_is_the_same_whatever_the_key(self, avatar, rolled):
        again = roll(avatar, unica.reset(avatar, jax.random.key(9)))
        np.testing.assert_array_equal(again.posmap, rolled.posmap)
        np.testing.assert_array_equal(again.root, rolled.root)

    def test_a_batch_of_states_is_each_alone(self, avatar, rolled):
        states = jax.vmap(lambda k: unica.reset(avatar, k))(jax.random.split(jax.random.key(1), 2))
        found = jax.jit(jax.vmap(lambda s: roll(avatar, s)))(states)
        for k in range(2):
            np.testing.assert_allclose(found.posmap[k], rolled.posmap, atol=2e-4)

    def test_steps_are_predictions_from_the_last_three_maps(self, avatar, rolled):
        context = unica.reset(avatar, jax.random.key(0)).context
        predict = jax.jit(feed_forward.predict)
        for k, action in enumerate(ACTIONS):
            texels = predict(avatar.atlas, avatar.dynamics, context[None], jnp.asarray([action]))[0]
            np.testing.assert_allclose(posmap.from_map(avatar.atlas, rolled.posmap[k]), texels, atol=2e-4)
            shift = (posmap.root(avatar.atlas, texels) - 0.5)[None, None]
            context = jnp.concatenate([context[1:], texels[None]]) - shift

    def test_forecasts_start_from_true_frames(self, avatar, tiny_data):
        texels, roots = forecast.forecast(avatar, tiny_data.held_out, np.array([4]), 2, jax.random.key(0))
        assert texels.shape == (1, 2, len(tiny_data.atlas.rows), 3) and np.isfinite(roots).all()


def test_it_is_measured_as_the_unet_is(avatar, tiny_data):
    chosen = np.array([0, 40])
    windows = batches.windows(tiny_data.held_out, 4, avatar.config.turn_window)
    held, actions = windows.groups(chosen, float(tiny_data.atlas.scale))
    error = evaluate.one_step(avatar, tiny_data, chosen, jax.random.key(0))
    predicted = jax.jit(feed_forward.predict)(avatar.atlas, avatar.dynamics, held[:, :3], actions)
    back = jax.jit(feed_forward.reconstruct)(avatar.atlas, avatar.dynamics, held[:, 3])
    predicted, back = np.asarray(predicted), np.asarray(back)
    scale = float(tiny_data.atlas.scale)
    np.testing.assert_allclose(error["model"], evaluate.millimetres(predicted, held[:, 3], scale), rtol=1e-2)
    around = evaluate.reconstruction(avatar, tiny_data, chosen)["autoencoder"]
    np.testing.assert_allclose(around, evaluate.millimetres(back, held[:, 3], scale), rtol=1e-2)


@pytest.mark.parametrize("name", ["ci", "small", "base", "paper"])
def test_it_has_as_many_parameters_as_the_unet(name):
    config = preset(name)
    count, beside = (
        functional.count(functional.shapes(*network))
        for network in (
            (Transformer, dataclasses.replace(feed_forward.sized(config), depth=1)),
            (Denoiser, config.latent.denoiser),
        )
    )
    sizes = feed_forward.sized(config)
    count += (sizes.depth - 1) * 20 * sizes.width**2
    assert count == pytest.approx(beside, rel=0.15)
