"""Arrays come out of pickles as they went in; anything that could run code does not come out at all."""

import os
import pickle
import subprocess

import numpy as np
import pytest

from avatarjax.io import pickles


def saved(folder, value, protocol=4):
    path = folder / "weights.pkl"
    path.write_bytes(pickle.dumps(value, protocol))
    return path


@pytest.mark.parametrize("protocol", [3, 4])
def test_nested_arrays_come_back(tmp_path, protocol):
    tree = {
        "conv": {"kernel": np.arange(6.0, dtype=np.float32).reshape(2, 3), "bias": np.zeros(0)},
        "names": ["a", ("b", 3)],
        "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "scalar": np.array(7, np.int8),
    }
    found = pickles.load_arrays(saved(tmp_path, tree, protocol))
    assert found["names"] == tree["names"]
    for a, b in ((found["conv"][k], tree["conv"][k]) for k in tree["conv"]):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    np.testing.assert_array_equal(found["fortran"], tree["fortran"])
    np.testing.assert_array_equal(found["scalar"], tree["scalar"])


def test_arrays_of_numpy_1_come_back(tmp_path):
    path = saved(tmp_path, np.arange(3), protocol=3)
    path.write_bytes(path.read_bytes().replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    np.testing.assert_array_equal(pickles.load_arrays(path), np.arange(3))


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_dictionaries_that_numpy_saved_come_back(tmp_path, protocol):
    value = {"K": [np.eye(3)], "scale": np.float32(2.5), "names": np.array(["a", "b"])}
    path = tmp_path / "annots.npy"
    np.save(path, value, allow_pickle=True)
    header = path.read_bytes()[:128]
    path.write_bytes(header + pickle.dumps(np.array(value, object), protocol))
    found = pickles.load_npy(path)
    np.testing.assert_array_equal(found["K"][0], np.eye(3))
    np.testing.assert_array_equal(found["names"], value["names"])
    assert found["scale"] == 2.5 and found["scale"].dtype == np.float32


def test_plain_npy_arrays_come_back(tmp_path):
    value = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.save(tmp_path / "a.npy", value)
    np.testing.assert_array_equal(pickles.load_npy(tmp_path / "a.npy"), value)
    np.save(tmp_path / "b.npy", np.array([{"x": 1}, None]), allow_pickle=True)
    assert pickles.load_npy(tmp_path / "b.npy").tolist() == [{"x": 1}, None]


def test_an_npy_file_that_lies_about_its_shape_is_refused(tmp_path):
    path = tmp_path / "annots.npy"
    np.save(path, {"x": 1}, allow_pickle=True)
    path.write_bytes(path.read_bytes()[:128] + pickle.dumps([1]))
    with pytest.raises(ValueError, match=r"annots\.npy is damaged or holds more than arrays: no array of shape \(\)"):
        pickles.load_npy(path)


class Runs:
    """Unpickled plainly, this would run a command."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call[0], self.call[1:]


@pytest.mark.parametrize(
    "value",
    [Runs(os.mkdir, "ran"), Runs(subprocess.Popen, "true"), Runs(eval, "1"), Runs(np.load, "x"), Runs(getattr, 1, "x")],
    ids=["os", "subprocess", "eval", "numpy.load", "getattr"],
)
def test_code_is_refused_and_not_run(tmp_path, monkeypatch, value):
    monkeypatch.chdir(tmp_path)
    path = saved(tmp_path, {"weights": value})
    with pytest.raises(ValueError, match="not an array"):
        pickles.load_arrays(path)
    assert list(tmp_path.iterdir()) == [path]


def test_subclasses_of_arrays_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"weights\.pkl is damaged or holds more than arrays"):
        pickles.load_arrays(saved(tmp_path, np.ma.masked_array([1, 2], [True, False])))


@pytest.mark.parametrize("data", [b"", b"\x80", b"not a pickle", pickle.dumps(np.arange(100), 4)[:-50]])
def test_damage_is_named(tmp_path, data):
    path = tmp_path / "weights.pkl"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"weights\.pkl is damaged"):
        pickles.load_arrays(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        pickles.load_arrays(tmp_path / "none.pkl")
