"""The pretrained networks, where they have been fetched; where CI runs, they must have been."""

import os

import pytest

from avatarjax.metrics import pretrained


def _fetched(name):
    if not pretrained.available(name) and "AVATARJAX_REQUIRE_WEIGHTS" not in os.environ:
        pytest.skip(f"the weights of {name} are not fetched: {pretrained.COMMAND}")
    return pretrained.load(name)


@pytest.fixture(scope="session")
def alex_weights():
    return _fetched("alex")


@pytest.fixture(scope="session")
def vgg_weights():
    return _fetched("vgg")


@pytest.fixture(scope="session")
def i3d_weights():
    return _fetched("i3d")
