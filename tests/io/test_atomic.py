"""Atomic writes: the whole file, or the old one."""

import pytest

from avatarjax.io import atomic


def test_file_appears_whole_with_its_folder(tmp_path):
    path = tmp_path / "new" / "a.txt"
    atomic.write_text(path, "größer")
    assert path.read_text(encoding="utf-8") == "größer"


def test_exception_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="half way"), atomic.replacing(path) as temporary:
        temporary.write_text("ne")
        raise RuntimeError("half way")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_old_file_stays_until_the_block_ends(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with atomic.replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_temporary_file_has_the_suffix_that_codecs_look_at(tmp_path):
    with atomic.replacing(tmp_path / "a.exr") as temporary:
        assert temporary.suffix == ".exr"


def test_result_can_be_read_by_others(tmp_path):
    atomic.write_text(tmp_path / "a.txt", "")
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o644
