"""Manifests of small folders of any files: whole, missing, damaged, outside."""

import json

import pytest

from avatarjax.data import manifest

AGAIN = "make it again"


@pytest.fixture
def folder(tmp_path):
    """Two files, one of them below, and a manifest."""
    (tmp_path / "below").mkdir()
    (tmp_path / "a.bin").write_bytes(b"abc")
    (tmp_path / "below" / "b.bin").write_bytes(b"")
    manifest.write(tmp_path, 7, ["a.bin", "below/b.bin"], colour="red")
    return tmp_path


def read(folder, needed=("a.bin",)):
    return manifest.read(folder, 7, needed, AGAIN)


def edit(folder, change):
    path = folder / manifest.NAME
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_a_whole_folder_is_read_and_checked(folder):
    found = read(folder)
    assert found["version"] == 7 and found["colour"] == "red"
    manifest.check(folder, found, AGAIN)


def test_sizes_and_checksums_are_those_of_the_files(folder):
    """SHA-256 of "abc" and of nothing are those of FIPS 180-2."""
    files = read(folder)["files"]
    assert [file["bytes"] for file in files.values()] == [3, 0]
    assert files["a.bin"]["sha256"] == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert files["below/b.bin"]["sha256"].startswith("e3b0c44298fc1c149afbf4c8996fb924")


def test_writing_leaves_nothing_else_behind(folder):
    assert sorted(path.name for path in folder.iterdir()) == ["a.bin", "below", manifest.NAME]


def test_a_file_that_is_not_listed_does_not_matter(folder):
    (folder / "notes.txt").write_text("mine")
    manifest.check(folder, read(folder), AGAIN)


@pytest.mark.parametrize("content", [b"abd", b"ab", b"abcd", b""])
def test_a_damaged_file_is_named(folder, content):
    (folder / "a.bin").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.bin is damaged .*make it again"):
        manifest.check(folder, read(folder), AGAIN)


def test_a_missing_file_is_named(folder):
    (folder / "below" / "b.bin").unlink()
    with pytest.raises(ValueError, match=r"b\.bin is missing: make it again"):
        manifest.check(folder, read(folder), AGAIN)


def test_a_folder_in_a_files_place_is_missing(folder):
    (folder / "a.bin").unlink()
    (folder / "a.bin").mkdir()
    with pytest.raises(ValueError, match=r"a\.bin is missing"):
        manifest.check(folder, read(folder), AGAIN)


def test_only_the_named_files_are_checked(folder):
    (folder / "a.bin").write_bytes(b"x")
    manifest.check(folder, read(folder), AGAIN, ["below/b.bin"])


def test_a_folder_without_manifest_is_unfinished(tmp_path):
    with pytest.raises(ValueError, match=r"no finished dataset .*make it again"):
        read(tmp_path)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"null", b"[]", b'{"version": 7, "files": {"a.bin": {}}}'])
def test_a_damaged_manifest_is_named(folder, content):
    (folder / manifest.NAME).write_bytes(content)
    with pytest.raises(ValueError, match=r"manifest\.json is damaged .*make it again"):
        read(folder)


def test_a_manifest_that_lists_too_little_is_damaged(folder):
    with pytest.raises(ValueError, match=r"does not list c\.bin, d\.bin"):
        read(folder, ["d.bin", "a.bin", "c.bin"])


@pytest.mark.parametrize("version", [6, 8, "7", None])
def test_other_versions_are_refused(folder, version):
    edit(folder, lambda m: m.update(version=version))
    with pytest.raises(ValueError, match=rf"version {version}, this is version 7: make it again"):
        read(folder)


@pytest.mark.parametrize("name", ["/a.bin", "../a.bin", "below/../../a.bin", "C:/a.bin", "below\\b.bin"])
def test_files_outside_the_folder_are_refused(folder, name):
    edit(folder, lambda m: m["files"].update({name: m["files"]["a.bin"]}))
    with pytest.raises(ValueError, match="which is not a file of this dataset"):
        read(folder)


def test_the_fingerprint_is_that_of_the_files_alone(folder):
    before = manifest.fingerprint(read(folder))
    edit(folder, lambda m: m.update(colour="blue"))
    assert manifest.fingerprint(read(folder)) == before
    (folder / "a.bin").write_bytes(b"abd")
    manifest.write(folder, 7, ["a.bin", "below/b.bin"], colour="red")
    assert manifest.fingerprint(read(folder)) != before
