"""Small random scenes for the tests of the kernel."""

import jax.numpy as jnp
import numpy as np

from avatarjax import Camera, Gaussians, look_at


def random_gaussians(n=60, seed=0, size=0.08, spread=0.5, channels=3) -> Gaussians:
    """A ball of n Gaussians of mixed sizes and opacities about the origin."""
    rng = np.random.default_rng(seed)
    fields = {
        "means": spread * rng.normal(size=(n, 3)),
        "log_scales": np.log(size) + 0.5 * rng.normal(size=(n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "logit_opacities": rng.normal(size=n),
        "colors": rng.uniform(size=(n, channels)),
    }
    return Gaussians(**{k: jnp.asarray(v, jnp.float32) for k, v in fields.items()})


def front_camera(width=40, height=28, eye=(0.3, 0.4, 3.0)) -> Camera:
    return look_at(eye, (0.0, 0.0, 0.0), width=width, height=height)
