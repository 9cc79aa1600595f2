"""Strict by default: every public shape annotation is checked, rank promotion and warnings are errors."""

import os

import jaxtyping

# Before anything imports avatarjax: check the shape annotations of every function of the package with beartype.
_hook = jaxtyping.install_import_hook("avatarjax", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_compilation_cache_dir", os.environ.get("AVATARJAX_TEST_CACHE") or None)


@pytest.fixture
def key():
    """A PRNG key; split it where more than one is needed."""
    return jax.random.key(0)
