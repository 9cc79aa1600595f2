"""Experiments switch JAX' compilation cache on; tests that come after them run without it."""

import contextlib

import jax
from jax.experimental.compilation_cache import compilation_cache


@contextlib.contextmanager
def cache_restored():
    """The compilation cache is afterwards as it was before."""
    before = jax.config.jax_compilation_cache_dir
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        # Once opened the cache stays in use for all that follows, whatever the configuration says.
        compilation_cache.reset_cache()
