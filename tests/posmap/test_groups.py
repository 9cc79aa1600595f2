"""The public file layout: fabricated groups always, the paper's own when the environment names their folder."""

import os
from pathlib import Path

import numpy as np
import pytest

from avatarjax.posmap import groups, windows

PUBLIC = os.environ.get("AVATARJAX_UNICA_PUBLIC", "")
public_groups = sorted(Path(PUBLIC).glob("*/*_?????_*")) if PUBLIC else []


@pytest.fixture
def fabricated(tmp_path):
    rng = np.random.default_rng(0)
    raw = rng.uniform(0.1, 0.9, (4, 32, 32, 3)).astype(np.float32)
    raw[:, rng.random((32, 32)) < 0.7] = 0
    folder = tmp_path / groups.group_name("0-w", 1, "Idle")
    groups.write_group(folder, raw)
    return folder, raw


def test_fabricated_group_round_trips_bit_for_bit(fabricated):
    folder, raw = fabricated
    np.testing.assert_array_equal(groups.read_group(folder).view(np.uint32), raw.view(np.uint32))


def test_axes_round_trip_to_1e_7(fabricated):
    _, raw = fabricated
    ours, mask = groups.from_public(raw)
    np.testing.assert_allclose(groups.to_public(ours, mask), raw, atol=1e-7)


def test_axes_are_ours(fabricated):
    _, raw = fabricated
    ours, mask = groups.from_public(raw)
    r, g, b = raw[mask].T
    np.testing.assert_allclose(ours[mask], np.stack([b, r, 1 - g], -1), atol=1e-7)


def test_names_round_trip():
    assert groups.parse_group_name("0-w_00001_Idle") == ("0-w", 1, "Idle")
    with pytest.raises(ValueError, match="not a group folder"):
        groups.parse_group_name("somewhere")


def test_missing_and_damaged_files_are_named(fabricated):
    folder, raw = fabricated
    (folder / "3.exr").write_bytes((folder / "3.exr").read_bytes()[:100])
    with pytest.raises(ValueError, match=r"3\.exr"):
        groups.read_group(folder)
    (folder / "2.exr").unlink()
    with pytest.raises(ValueError, match=r"2\.exr does not exist"):
        groups.read_group(folder)
    raw[2, 0, 0] = 1 - raw[2, 0, 0]
    raw[2, 5] = 0.5
    groups.write_group(folder, raw)
    with pytest.raises(ValueError, match=r"3\.exr has another foreground"):
        groups.read_group(folder)


@pytest.mark.skipif(not public_groups, reason="AVATARJAX_UNICA_PUBLIC does not name the public groups' folder")
class TestPublic:
    @pytest.fixture(params=public_groups, ids=lambda p: p.parent.name)
    def folder(self, request):
        return request.param

    def test_raw_arrays_round_trip_bit_for_bit(self, folder, tmp_path):
        raw = groups.read_group(folder)
        groups.write_group(tmp_path / folder.name, raw)
        again = groups.read_group(tmp_path / folder.name)
        np.testing.assert_array_equal(again.view(np.uint32), raw.view(np.uint32))

    def test_the_figure_stands_upright_and_is_0_7_tall(self, folder):
        ours, mask = groups.from_public(groups.read_group(folder))
        extent = np.ptp(ours[mask], axis=0)
        assert extent.argmax() == 1
        assert extent[1] == pytest.approx(0.7, abs=0.05)

    def test_the_front_window_shows_the_front(self, folder):
        ours, mask = groups.from_public(groups.read_group(folder))
        depth = {}
        for w in windows(128):
            block = np.s_[2, w.row : w.row + w.height, w.col : w.col + w.width]
            depth[w.name] = ours[block][mask[block]].mean(0)
        assert depth["front"][2] > depth["back"][2] + 0.02
        assert depth["above"][1] > depth["below"][1] + 0.02

    def test_axes_round_trip_to_1e_7(self, folder):
        raw = groups.read_group(folder)
        np.testing.assert_allclose(groups.to_public(*groups.from_public(raw)), raw, atol=1e-7)
