"""Strict by default: every public shape annotation is checked, rank promotion and warnings are errors."""

import gc
import os
import tempfile
from pathlib import Path

import filelock
import jaxtyping

# Most of a run is compiling, and most tests run what they compile but once: without the emitters of fused loops a
# quarter of it is saved, and with little optimisation another sixth.
_quick = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_quick}".strip()

# Before anything imports avatarjax: check the shape annotations of every function of the package with beartype.
_hook = jaxtyping.install_import_hook("avatarjax", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
# The same programs are compiled by many modules, and anew after their caches were cleared: a run keeps them on disk,
# and its worker processes, which inherit the environment, share them.
_cache = tempfile.TemporaryDirectory(prefix="avatarjax-tests-", ignore_cleanup_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ.setdefault("AVATARJAX_TEST_CACHE", _cache.name))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_collection_modifyitems(items):
    """Whole experiments, which take minutes each, come first: then processes that share the files end together."""
    items.sort(key=lambda item: item.path.parent != Path(__file__).parent)


@pytest.fixture
def key():
    """A PRNG key; split it where more than one is needed."""
    return jax.random.key(0)


@pytest.fixture(scope="module", autouse=True)
def few_mappings():
    """Forget compiled functions after a module once they hold many of the memory mappings that a process may have.

    Linux allows 65,530; XLA crashes where it gets no more, which all tests in one process come close to.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def tiny_spec():
    """The smallest dataset that holds every kind of data."""
    from avatarjax.data import dataset

    return dataset.DatasetSpec(
        avatar="cowgirl",
        size=32,
        upscaled=64,
        transition_frames=60,
        held_out_frames=60,
        image_poses=2,
        image_views=2,
        standing_views=2,
        image_size=32,
        script=(1,) * 10 + (2,) * 10,
        cloth_steps=4,
        vertices="float16",
    )


@pytest.fixture(scope="session")
def tiny_folder(tiny_spec):
    """The folder of the tiny dataset, built once in a run, by the process that needs it first: read only."""
    from avatarjax.data import building, dataset

    shared = Path(os.environ["AVATARJAX_TEST_CACHE"])
    with filelock.FileLock(shared / "tiny.lock"):
        if not dataset.matches(shared / "tiny", tiny_spec):
            building.build(shared / "tiny", tiny_spec, progress=False)
    return shared / "tiny"


@pytest.fixture(scope="session")
def tiny_data(tiny_folder):
    """The tiny dataset."""
    from avatarjax.data import dataset

    return dataset.load(tiny_folder)
