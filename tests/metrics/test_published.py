"""What the papers say of their own tables checks that the numbers were typed in rightly."""

import numpy as np
import pytest

from avatarjax.metrics import published
from avatarjax.metrics.published import PrintedTable

TABLES = {name: t for name, t in vars(published).items() if isinstance(t, PrintedTable)}
AVATARS = ("monk", "cowgirl", "survival", "berserker", "ghostlady")


@pytest.mark.parametrize("method", [published.ANIMATABLE, published.MIXAMO, published.UNICA])
@pytest.mark.parametrize("column, digits", [("FVD", 2), ("PSNR", 2), ("LPIPS", 3)])
def test_unicas_averages_are_those_of_its_avatars(method, column, digits):
    mean = np.mean([published.UNICA_C.at((avatar, method), column).value for avatar in AVATARS])
    # Rows are rounded themselves: the mean of five may be off by half a digit more.
    assert published.UNICA_2.at(method, column).value == pytest.approx(mean, abs=1.01 * 10**-digits)


@pytest.mark.parametrize("column", ["FVD", "PSNR", "LPIPS"])
def test_unicas_full_model_is_the_same_in_every_table(column):
    same = {
        published.UNICA_2.at(published.UNICA, column).value,
        published.UNICA_3.at("with PCA", column).value,
        published.UNICA_B.at(10, column).value,
    }
    assert len(same) == 1


# SMAD 4.2: what each component gains in PSNR, and by how many percent it lowers LPIPS.
@pytest.mark.parametrize(
    "before, after, gain, percent",
    [
        ("A0", "A1", 0.84, 10.3),
        ("A2", "A3", 0.68, 10.2),
        ("A0", "A4", 2.68, 31.0),
        ("B0", "B4", 5.83, 40.3),
        ("C0", "C4", 3.60, 32.2),
    ],
)
def test_smads_gains_are_those_of_its_text(before, after, gain, percent):
    table = published.SMAD_2
    psnr = [table.at(row, "PSNR").value for row in (before, after)]
    lpips = [table.at(row, "LPIPS").value for row in (before, after)]
    assert psnr[1] - psnr[0] == pytest.approx(gain, abs=1e-9)
    assert 100 * (1 - lpips[1] / lpips[0]) == pytest.approx(percent, abs=0.06)


@pytest.mark.parametrize("column", ["PSNR", "SSIM", "LPIPS"])
def test_smads_full_model_is_the_same_in_every_table(column):
    row = [published.SMAD_2.at(name, column).value for name in ("A4", "B4", "C4")]
    row += [published.SMAD_3.at("test", column).value, published.SMAD_4.at((published.SMAD, "test"), column).value]
    assert len(set(row)) == 1
    assert published.SMAD_3.at("train", column).value == published.SMAD_4.at((published.SMAD, "train"), column).value


@pytest.mark.parametrize("method", [published.GART, published.AVATAR_3DGS, published.EXAVATAR, published.SMAD])
def test_every_method_has_every_subject(method):
    assert len([row for row in published.SMAD_1A.rows if row[1] == method]) == 5


@pytest.mark.parametrize("name", TABLES)
def test_numbers_are_in_their_range(name):
    table = TABLES[name]
    ranges = {"PSNR": (9, 40), "SSIM": (0.9, 1), "LPIPS": (0.02, 0.3), "FVD": (100, 700), "LPIPS x 1000": (20, 60)}
    for row in table.rows:
        for column, (low, high) in ranges.items():
            if column in table.columns:
                assert low < table.at(row, column).value < high


def test_a_number_knows_where_it_is_printed():
    assert published.UNICA_D_TURNS.at("UNICA", "180 degrees") == (13.77, "UNICA Table D and D.4")


@pytest.mark.parametrize("row, column, missing", [("Maximo", "FVD", "no row 'Maximo'"), ("UNICA", "SSIM", "no column")])
def test_what_is_not_printed_is_named(row, column, missing):
    with pytest.raises(ValueError, match=missing):
        published.UNICA_2.at(row, column)
