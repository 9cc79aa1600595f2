"""LPIPS is that of its authors' package: known answers, the same heads, and torch's forward pass where torch is."""

import hashlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.metrics import lpips
from tests.metrics.pictures import LPIPS, pairs

# SHA-256 of the float32 bytes of the five heads in that package, one after another.
HEADS = {
    "alex": "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4",
    "vgg": "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78",
}


@pytest.fixture(scope="session")
def networks(alex_weights, vgg_weights):
    return {name: lpips.load(name) for name in lpips.NAMES}


@pytest.fixture(params=lpips.NAMES)
def network(request, networks):
    return networks[request.param]


@pytest.fixture(scope="module")
def pictures():
    return pairs()


def test_known_answers_on_three_pictures(network, pictures):
    np.testing.assert_allclose(lpips.distance(network, *pictures), LPIPS[network.name], atol=1e-5)


def test_the_heads_are_those_of_the_authors(network):
    heads = b"".join(np.asarray(head).tobytes() for head in network.heads)
    assert hashlib.sha256(heads).hexdigest() == HEADS[network.name]


def test_it_is_a_symmetric_distance_of_any_batch_shape(networks, pictures):
    net = networks["alex"]
    a, b = (x[:2].reshape(1, 2, *x.shape[1:]) for x in pictures)
    found = lpips.distance(net, a, b)
    assert found.shape == (1, 2)
    np.testing.assert_allclose(found, lpips.distance(net, b, a), rtol=1e-6)
    np.testing.assert_allclose(lpips.distance(net, a, a), 0, atol=1e-10)
    np.testing.assert_allclose(lpips.distance(net, a[0, 1], b[0, 1]), found[0, 1], rtol=1e-5)


def test_all_may_be_compared_with_one(networks, pictures):
    net, (a, b) = networks["alex"], pictures
    each = [float(lpips.distance(net, x, b[0])) for x in a]
    np.testing.assert_allclose(lpips.distance(net, a, b[0]), each, rtol=1e-5)
    with pytest.raises(ValueError, match="different shapes"):
        lpips.distance(net, a, b[0, 1:])


def test_sides_need_not_be_equal_or_even(networks, pictures):
    crop = [x[0, :33, :45] for x in pictures]
    for net in networks.values():
        assert 0 < float(lpips.distance(net, *crop)) < 1


def test_the_gradient_is_the_slope(networks, pictures):
    """Along the gradient's own signs, by a central difference: steps small enough to cross few of the kinks."""
    net = networks["alex"]
    a, b = (0.9 * jnp.asarray(x[1]) + 0.05 for x in pictures)
    slope = jax.jit(jax.grad(lpips.distance, argnums=1))(net, a, b)
    step = 1e-4 * jnp.sign(slope)
    rise = lpips.distance(net, a + step, b) - lpips.distance(net, a - step, b)
    np.testing.assert_allclose(rise, 2 * jnp.sum(slope * step), rtol=0.02)


def test_dead_features_have_a_gradient_of_zero(networks):
    """Where no feature of a layer is excited its length is zero, whose root has no derivative."""
    net = networks["alex"]
    dead = net.replace(biases=tuple(-100 * jnp.ones_like(b) for b in net.biases))
    a, b = jnp.zeros((32, 32, 3)), jnp.ones((32, 32, 3))
    value, slope = jax.value_and_grad(lpips.distance, argnums=1)(dead, a, b)
    assert float(value) == 0
    np.testing.assert_array_equal(slope, 0)


def test_bad_images_are_refused(networks, pictures):
    net, (a, b) = networks["alex"], pictures
    with pytest.raises(ValueError, match="three channels"):
        lpips.distance(net, a[..., :1], b[..., :1])
    with pytest.raises(ValueError, match="32 pixels or more"):
        lpips.distance(net, a[:, :31], b[:, :31])
    with pytest.raises(ValueError, match=r"within \[0, 1\]"):
        lpips.distance(net, 2 * a, b)
    with pytest.raises(ValueError, match="different shapes"):
        lpips.distance(net, a, b[:2])
    with pytest.raises(ValueError, match="unknown LPIPS network 'squeeze'"):
        lpips.load("squeeze")


def test_torch_sees_the_same(network, pictures):
    torch = pytest.importorskip("torch")
    functional = torch.nn.functional

    def features(image):
        x = torch.tensor((image - lpips._MEAN) / lpips._STD).permute(0, 3, 1, 2)
        layers = zip(network.kernels, network.biases, strict=True)
        for layer in lpips._ALEX if network.name == "alex" else lpips._VGG:
            if layer == lpips._POOL:
                x = functional.max_pool2d(x, 3 if network.name == "alex" else 2, 2)
                continue
            kernel, bias = (torch.tensor(np.asarray(w)) for w in next(layers))
            x = torch.relu(functional.conv2d(x, kernel.permute(3, 2, 0, 1), bias, layer[0], layer[1]))
            if layer[2]:
                yield x / (x.norm(dim=1, keepdim=True) + 1e-10)

    total = 0
    for head, x, y in zip(network.heads, *map(features, pictures), strict=True):
        weights = torch.tensor(np.asarray(head)).reshape(1, -1, 1, 1)
        total = total + functional.conv2d((x - y) ** 2, weights).mean(dim=(1, 2, 3))
    np.testing.assert_allclose(lpips.distance(network, *pictures), total.numpy(), atol=1e-4)
