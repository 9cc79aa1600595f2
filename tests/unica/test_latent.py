"""Maps to images to latents, and the loss of the fourth frame's noise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.diffusion import schedules
from avatarjax.unica import batches, latent

encode = jax.jit(latent.encode, static_argnums=0)


@pytest.fixture(scope="module")
def groups(tiny_data):
    windows = batches.windows(tiny_data.train, 4, (0, 25))
    return jnp.asarray(windows.groups(np.array([5, 300]), float(tiny_data.atlas.scale))[0])


def test_images_come_back_as_texels(tiny_data, latent_dynamics, groups):
    images = latent.to_images(tiny_data.atlas, latent_dynamics, groups[0])
    np.testing.assert_allclose(latent.from_images(tiny_data.atlas, latent_dynamics, images), groups[0], atol=1e-6)


def test_the_mean_map_is_an_empty_image(tiny_data, latent_dynamics):
    images = latent.to_images(tiny_data.atlas, latent_dynamics, latent_dynamics.map_mean[None])
    np.testing.assert_array_equal(images, 0)


def test_the_background_of_decoded_images_is_ignored(tiny_data, latent_dynamics, groups):
    images = latent.to_images(tiny_data.atlas, latent_dynamics, groups[0])
    painted = jnp.where(tiny_data.atlas.mask[None, :, :, None], images, 99.0)
    np.testing.assert_allclose(latent.from_images(tiny_data.atlas, latent_dynamics, painted), groups[0], atol=1e-6)


@pytest.fixture(scope="module")
def stages(config, tiny_data, latent_dynamics, groups):
    """Latents with the statistics of `latent_dynamics`, and with none."""
    plain = latent_dynamics.replace(latent_mean=jnp.zeros(4), latent_scale=jnp.ones(4))
    return [encode(config.latent, tiny_data.atlas, d, groups[0]) for d in (latent_dynamics, plain)]


def test_latents_are_brought_to_unit_size(config, latent_dynamics, stages):
    scaled, plain = (np.asarray(x) for x in stages)
    side = config.size // config.latent.vae.downsampling
    assert scaled.shape == (4, side, side, 4)
    expected = (plain - np.asarray(latent_dynamics.latent_mean)) / np.asarray(latent_dynamics.latent_scale)
    np.testing.assert_allclose(scaled, expected, atol=1e-4)


class TestLoss:
    """With a network that is replaced by a closed form."""

    @pytest.fixture
    def settings(self, config):
        return dataclasses.replace(config.latent, from_last=False, min_snr=0.0, context_noise=0.0)

    def loss(self, monkeypatch, settings, tiny_data, dynamics, groups, network):
        bind = latent.bind
        monkeypatch.setattr(latent, "bind", lambda cls, c, p: network if cls is latent.Denoiser else bind(cls, c, p))
        jitted = jax.jit(
            lambda key, g: latent.diffusion_loss(settings, tiny_data.atlas, dynamics, key, g, jnp.array([1, 2]))
        )
        return jitted(jax.random.key(3), groups)

    def test_the_exact_noise_has_no_loss(self, monkeypatch, settings, tiny_data, latent_dynamics, groups):
        target = encode(settings, tiny_data.atlas, latent_dynamics, groups[:, 3])
        signal = schedules.alphas_cumprod(settings.schedule, settings.train_timesteps)

        def knows(z, timestep, action):
            a = signal[timestep].reshape(-1, 1, 1, 1)
            return (z[:, 3] - jnp.sqrt(a) * target) / jnp.sqrt(1 - a)

        loss = self.loss(monkeypatch, settings, tiny_data, latent_dynamics, groups, knows)
        assert float(loss) == pytest.approx(0, abs=1e-4)

    def test_the_change_from_frame_t_is_all_that_from_last_asks_for(
        self, monkeypatch, settings, tiny_data, latent_dynamics, groups
    ):
        target = encode(settings, tiny_data.atlas, latent_dynamics, groups[:, 3])
        settings = dataclasses.replace(settings, from_last=True)
        loss = self.loss(
            monkeypatch, settings, tiny_data, latent_dynamics, groups, lambda z, t, a: target - z[:, latent.CONTEXT - 1]
        )
        assert float(loss) == pytest.approx(0, abs=1e-4)

    def test_min_snr_only_lowers_the_weight_of_little_noise(
        self, monkeypatch, settings, tiny_data, latent_dynamics, groups
    ):
        def loss(cap):
            changed = dataclasses.replace(settings, min_snr=cap)
            nothing = lambda z, t, a: jnp.zeros_like(z[:, 3])  # noqa: E731
            return float(self.loss(monkeypatch, changed, tiny_data, latent_dynamics, groups, nothing))

        plain = loss(0.0)
        assert loss(1e6) == pytest.approx(plain, rel=1e-5)
        assert loss(1e-3) < 0.9 * plain

    def test_no_answer_costs_the_variance_of_the_noise(self, monkeypatch, settings, tiny_data, latent_dynamics, groups):
        loss = self.loss(
            monkeypatch, settings, tiny_data, latent_dynamics, groups, lambda z, t, a: jnp.zeros_like(z[:, 3])
        )
        assert float(loss) == pytest.approx(1, abs=0.15)

    def test_the_context_is_clean_but_for_its_own_noise(
        self, monkeypatch, settings, tiny_data, latent_dynamics, groups
    ):
        """Only the fourth frame is noised by the schedule: a network that answers any difference answers none."""
        context = encode(settings, tiny_data.atlas, latent_dynamics, groups[:, :3].reshape(6, -1, 3))
        context = context.reshape(2, 3, *context.shape[1:])

        def spread(z, timestep, action):
            return 1e4 * jnp.full_like(z[:, 3], jnp.abs(z[:, :3] - context).max())

        loss = self.loss(monkeypatch, settings, tiny_data, latent_dynamics, groups, spread)
        assert float(loss) == pytest.approx(1, abs=0.5)

    def test_with_fewer_context_frames_the_newest_are_seen(
        self, monkeypatch, settings, tiny_data, latent_dynamics, groups
    ):
        """One context frame: the network gets frame t and the noisy one, and the target is the same."""
        target, last = (encode(settings, tiny_data.atlas, latent_dynamics, groups[:, k]) for k in (3, 2))
        one = dataclasses.replace(settings.denoiser, context=1)
        settings = dataclasses.replace(settings, from_last=True, denoiser=one)

        def knows(z, timestep, action):
            assert z.shape[1] == 2
            return target - last + 1e3 * (z[:, 0] - last)

        loss = self.loss(monkeypatch, settings, tiny_data, latent_dynamics, groups, knows)
        assert float(loss) == pytest.approx(0, abs=1e-3)

    @pytest.mark.parametrize("share", [0.0, 1.0])
    def test_actions_are_dropped_to_the_null_action(
        self, monkeypatch, settings, tiny_data, latent_dynamics, groups, share
    ):
        settings = dataclasses.replace(settings, action_dropout=share)
        loss = self.loss(
            monkeypatch,
            settings,
            tiny_data,
            latent_dynamics,
            groups,
            lambda z, t, a: 1e3 * jnp.ones_like(z[:, 3]) * (a == settings.denoiser.null_action)[:, None, None, None],
        )
        assert (float(loss) > 1e5) == (share == 1.0)


def test_sampling_decodes_the_point_that_the_noise_leads_to(
    monkeypatch, config, tiny_data, latent_dynamics, groups, stages
):
    """A network that knows the fourth latent exactly: the sample is that latent, decoded."""
    settings = dataclasses.replace(config.latent, from_last=False)
    target = stages[0][3:]
    signal = schedules.alphas_cumprod(settings.schedule, settings.train_timesteps)

    def knows(z, timestep, action):
        a = signal[timestep].reshape(-1, 1, 1, 1)
        return (z[:, 3] - jnp.sqrt(a) * target) / jnp.sqrt(1 - a)

    expected = jax.jit(lambda z: latent.decode(settings, tiny_data.atlas, latent_dynamics, z))(target)
    bind = latent.bind
    monkeypatch.setattr(latent, "bind", lambda cls, c, p: knows if cls is latent.Denoiser else bind(cls, c, p))
    got = jax.jit(
        lambda context: latent.sample(
            settings, tiny_data.atlas, latent_dynamics, jax.random.key(0), context, jnp.array([1])
        )
    )(groups[:1, :3])
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_contexts_have_noise_of_their_own_and_a_share_has_none(config):
    settings = dataclasses.replace(config.latent, context_noise=0.5, clean_contexts=0.3)
    noise = np.asarray(latent._context_noise(settings, jax.random.key(0), (4000, 3, 4, 4, 2)))
    size = noise.std((2, 3, 4))
    clean = (size == 0).all(1)
    assert clean.mean() == pytest.approx(0.3, abs=0.03)
    assert not (size[~clean] == 0).any()
    assert size.max() < 0.5 * 1.6 and size[~clean].mean() == pytest.approx(0.25, abs=0.02)
    assert np.abs(np.corrcoef(size[~clean].T) - np.eye(3)).max() < 0.06  # a level for each frame


def test_offset_noise_is_shared_by_the_places_of_a_channel(config):
    def noise(offset):
        settings = dataclasses.replace(config.latent, noise_offset=offset)
        return np.asarray(latent._noise(settings, jax.random.key(0), (500, 8, 8, 4)))

    plain, moved = noise(0.0), noise(0.5)
    assert plain.std() == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(np.ptp(moved - plain, axis=(1, 2)), 0, atol=1e-5)
    assert (moved - plain)[:, 0, 0].std() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("scale, actions", [(1.0, [1]), (2.0, [5, 1])])
def test_guidance_asks_the_network_without_action_only_where_it_is_on(
    monkeypatch, config, tiny_data, latent_dynamics, groups, scale, actions
):
    """The calls of one traced sampling step, by the action that they are given."""
    settings = dataclasses.replace(config.latent, guidance=scale, from_last=False, sample_steps=1)
    asked = []

    def network(z, timestep, action):
        asked.append(action)
        return z[:, 3] * (1.0 + action[:, None, None, None])

    bind = latent.bind
    monkeypatch.setattr(latent, "bind", lambda cls, c, p: network if cls is latent.Denoiser else bind(cls, c, p))
    monkeypatch.setattr(latent.samplers.jax.lax, "scan", lambda step, x, inputs: step(x, [i[0] for i in inputs]))
    sampled = []
    monkeypatch.setattr(latent, "decode", lambda c, a, d, z: sampled.append(z) or groups[:1, 3])
    latent.sample(settings, tiny_data.atlas, latent_dynamics, jax.random.key(0), groups[:1, :3], jnp.array([1]))
    assert [int(a[0]) for a in asked] == actions
    start = jax.random.normal(jax.random.key(0), sampled[0].shape)
    signal = schedules.alphas_cumprod(settings.schedule, settings.train_timesteps)[-1]
    noise = start * (2.0 if scale == 1.0 else 6.0 + 2.0 * (2.0 - 6.0))
    np.testing.assert_allclose(sampled[0], (start - jnp.sqrt(1 - signal) * noise) / jnp.sqrt(signal), rtol=1e-4)


def test_the_autoencoders_loss_is_its_foreground_error(config, tiny_data, latent_dynamics, groups):
    """Whatever is decoded outside the mask costs nothing, and the error is told in normalised units."""
    value, metrics = jax.jit(lambda k: latent.vae_loss(config.latent, tiny_data.atlas, latent_dynamics, k, groups[0]))(
        jax.random.key(0)
    )
    scale = float(latent_dynamics.map_scale)
    expected = float(metrics["rmse"]) ** 2 / scale**2 + config.latent.kl_weight * float(metrics["kl"])
    assert float(value) == pytest.approx(expected, rel=1e-4)
    assert posmap.root(tiny_data.atlas, groups[0, 2]) == pytest.approx(0.5, abs=1e-4)
