"""Weights come into the cache whole and checked, or not at all."""

import hashlib
import io
import pickle
import tarfile

import numpy as np
import pytest

from avatarjax.metrics import pretrained


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """A folder with an archive of one small network, known as "lpips" and "alex", and an empty cache."""
    monkeypatch.setenv("AVATARJAX_CACHE", str(tmp_path / "cache"))
    content = pickle.dumps({"kernel": np.arange(4, dtype=np.float32)})
    packed = tmp_path / "shelf" / "tiny-1.0.tar.gz"
    packed.parent.mkdir()
    with tarfile.open(packed, "w:gz") as tar:
        for name, data in {"tiny-1.0/setup.py": b"raise SystemExit", "tiny-1.0/net.ckpt": content}.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    digest = hashlib.sha256(packed.read_bytes()).hexdigest()
    archive = pretrained.Archive("tiny==1.0", packed.name, digest, "a test")
    weights = pretrained.Weights("lpips", "tiny-1.0/net.ckpt", hashlib.sha256(content).hexdigest())
    monkeypatch.setattr(pretrained, "ARCHIVES", {"lpips": archive})
    monkeypatch.setattr(pretrained, "WEIGHTS", {"alex": weights})
    return packed.parent


def test_an_archive_on_the_shelf_is_unpacked_into_the_cache(shelf):
    assert not pretrained.available("alex")
    (path,) = pretrained.fetch("lpips", shelf)
    assert path == pretrained.cache_folder() / "net.ckpt" and pretrained.available("alex")
    np.testing.assert_array_equal(pretrained.load("alex")["kernel"], np.arange(4))
    assert [p.name for p in path.parent.iterdir()] == ["net.ckpt"]


def test_what_is_there_is_not_fetched_again(shelf):
    pretrained.fetch("lpips", shelf)
    (shelf / "tiny-1.0.tar.gz").unlink()
    pretrained.fetch("lpips", shelf)


def test_damaged_weights_are_named_and_mended(shelf):
    (path,) = pretrained.fetch("lpips", shelf)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match=r"net\.ckpt is damaged: delete it and run python -m"):
        pretrained.load("alex")
    pretrained.fetch("lpips", shelf)
    pretrained.load("alex")


def test_missing_weights_are_named_with_the_command(shelf):
    with pytest.raises(ValueError, match=r"run python -m avatarjax\.metrics\.pretrained lpips"):
        pretrained.load("alex")


def test_another_archive_is_refused(shelf):
    packed = shelf / "tiny-1.0.tar.gz"
    packed.write_bytes(packed.read_bytes() + b"x")
    with pytest.raises(ValueError, match="checksum differs"):
        pretrained.fetch("lpips", shelf)
    assert not pretrained.cache_folder().exists()


def test_a_download_that_fails_says_what_else_to_do(shelf, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(ValueError, match=r"could not download tiny==1\.0 .* --archives FOLDER"):
        pretrained.fetch("lpips")


def test_unknown_names_are_refused(shelf):
    with pytest.raises(ValueError, match="unknown network 'squeeze': choose one of alex"):
        pretrained.load("squeeze")
    with pytest.raises(ValueError, match="unknown archive 'fid': choose one of lpips"):
        pretrained.fetch("fid")


def test_the_command_says_where_they_are(shelf, capsys):
    assert pretrained.main(["lpips", "--archives", str(shelf)]) == 0
    assert str(pretrained.cache_folder() / "net.ckpt") in capsys.readouterr().out
    assert pretrained.main(["lpips", "--archives", str(shelf / "nothing")]) == 0, "it is there already"
    assert pretrained.main(["fid"]) == 1
    assert "unknown archive" in capsys.readouterr().err


def test_the_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.delenv("AVATARJAX_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert pretrained.cache_folder() == tmp_path / "avatarjax"


@pytest.mark.parametrize("name", ["alex", "vgg", "i3d"])
def test_the_real_weights_are_nested_arrays(name, request):
    weights = request.getfixturevalue(f"{name}_weights")

    def check(tree):
        for value in tree.values():
            if isinstance(value, dict):
                check(value)
            else:
                assert isinstance(value, np.ndarray) and value.dtype == np.float32 and np.isfinite(value).all()

    check(weights)
