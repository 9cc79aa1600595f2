"""The .ply layout of 3D Gaussian Splatting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import Gaussians
from avatarjax.io.ply import read_ply, write_ply


def cloud(n=5, sh=None):
    rng = np.random.default_rng(0)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,), "colors": (n, 3)}
    fields = {name: jnp.asarray(rng.normal(size=shape), jnp.float32) for name, shape in shapes.items()}
    return Gaussians(**fields, sh=None if sh is None else jnp.asarray(rng.normal(size=(n, sh, 3)), jnp.float32))


@pytest.mark.parametrize("n", [0, 1, 5])
@pytest.mark.parametrize("sh", [None, 3, 15])
def test_round_trip(tmp_path, n, sh):
    before = cloud(n, sh)
    write_ply(tmp_path / "a.ply", before)
    after = read_ply(tmp_path / "a.ply")
    assert jax.tree.structure(after) == jax.tree.structure(before)
    for x, y in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-6)


def test_grey_has_no_degree_0_coefficient(tmp_path):
    gaussians = cloud(1).replace(colors=jnp.full((1, 3), 0.5))
    write_ply(tmp_path / "a.ply", gaussians)
    body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
    np.testing.assert_array_equal(np.frombuffer(body, "<f4")[6:9], 0)


def test_rest_coefficients_are_stored_by_channel(tmp_path):
    gaussians = cloud(1, sh=3)
    write_ply(tmp_path / "a.ply", gaussians)
    body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
    np.testing.assert_array_equal(np.frombuffer(body, "<f4")[9:12], gaussians.sh[0, :, 0])


def test_properties_are_found_by_name_in_any_order_and_type(tmp_path):
    names = ["rot_0", "rot_1", "rot_2", "rot_3", "x", "y", "z", "opacity", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += ["scale_0", "scale_1", "scale_2"]
    header = "ply\nformat binary_little_endian 1.0\ncomment from elsewhere\nelement vertex 1\n"
    header += "".join(f"property double {name}\n" for name in names) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + np.arange(14, dtype="<f8").tobytes())
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").means[0], [4, 5, 6])


def broken_files(tmp_path):
    write_ply(tmp_path / "good.ply", cloud())
    good = (tmp_path / "good.ply").read_bytes()
    return {
        "truncated": good[:-1],
        "header does not end": good[:100],
        "format ascii": good.replace(b"binary_little_endian", b"ascii"),
        "not a .ply file": b"\x89PNG\r\n",
        "not a cloud of Gaussians: it has no opacity": good.replace(b" opacity", b" density"),
        "not three channels": good.replace(b" nx", b" f_rest_0"),
    }


@pytest.mark.parametrize("message", ["truncated", "header does not end", "format ascii", "not a .ply file",
                                     "not a cloud of Gaussians: it has no opacity", "not three channels"])  # fmt: skip
def test_broken_file_is_refused_by_name(tmp_path, message):
    path = tmp_path / "bad.ply"
    path.write_bytes(broken_files(tmp_path)[message])
    with pytest.raises(ValueError, match=message) as error:
        read_ply(path)
    assert str(path) in str(error.value)


def test_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"nothing\.ply does not exist"):
        read_ply(tmp_path / "nothing.ply")


def test_batch_of_clouds_is_refused(tmp_path):
    with pytest.raises(ValueError, match="one cloud"):
        write_ply(tmp_path / "a.ply", jax.tree.map(lambda x: x[None], cloud()))
