"""python -m experiments.data on a dataset that lies there already: measuring, pictures, report, refusals."""

import json
import shutil

import pytest

from avatarjax.data import dataset
from avatarjax.io import exr
from experiments import data
from tests.caching import cache_restored


@pytest.fixture(scope="module")
def run(tiny_folder, tiny_spec, tmp_path_factory):
    """The folder of results after a run that finds its dataset finished."""
    out = tmp_path_factory.mktemp("runs")
    folder = out / "data" / "cowgirl" / "ci"
    shutil.copytree(tiny_folder, folder / "dataset")
    with pytest.MonkeyPatch.context() as patch, cache_restored():
        patch.setattr(data, "spec", lambda *_: tiny_spec)
        assert data.main(["--avatar", "cowgirl", "--preset", "ci", "--out", str(out)]) == 0
    return folder


def test_the_dataset_is_reused(run, tiny_folder):
    assert dataset.fingerprint(run / "dataset") == dataset.fingerprint(tiny_folder)


def test_the_numbers_are_measured(run):
    numbers = json.loads((run / "quality.json").read_text())
    assert numbers["frames"] == 1200
    assert numbers["share of vertex-frames under 5 mm deep"] > 0.99
    assert 0 < numbers["strain median"] < numbers["strain 99th percentile"] < 2
    assert numbers["foot slide median mm a step"] < 10
    assert numbers["means"]["frames of a 90 degree turn"]["n"] == 8
    assert numbers["means"]["foot slide, mm a step"]["groups"] == 20
    assert (numbers["frames of a 180 degree turn"], numbers["frames of a 90 degree turn"]) == (12, 9)


def test_the_sheet_shows_six_moments_from_four_sides(run):
    assert exr.read_png(run / "contact_sheet.png").shape == (4 * 320, 6 * 320, 3)


def test_the_report_has_the_pictures_in_it(run):
    page = (run / "report.html").read_text()
    assert page.count("data:image/png;base64") == 1 and page.count("data:video/mp4;base64") == 1
    assert "at least 0.999" in page
    for text in ("jaxlib", "--avatar cowgirl --preset ci --seed 0", "foot slide, mm a step", "UNICA Table D and D.4"):
        assert text in page


@pytest.mark.parametrize("arguments, said", [(("cow", "ci"), "monk, cowgirl"), (("monk", "huge"), "ci, small, paper")])
def test_unknown_names_are_refused_with_the_known_ones(arguments, said):
    with pytest.raises(ValueError, match=said):
        data.spec(*arguments, 0)
