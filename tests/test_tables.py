"""Tables as Markdown, what they say of the paper's ordering, and their memory; no run is needed."""

import math
import typing

import jax
import numpy as np
import pytest

from avatarjax.metrics.published import UNICA_3
from avatarjax.metrics.statistics import Estimate
from experiments.tables import __main__ as tables
from experiments.tables import deformers
from experiments.tables.table import Notebook, Table, cell, mark, ordering


def test_markdown_has_rows_remarks_and_pictures():
    rows = [["ours", 12.345, None], ["paper", UNICA_3.at("with PCA", "FVD"), "text"]]
    text = Table("Title", "How.", ["", "a", "b"], rows, ["said"], [("a.png", "seen")]).markdown()
    assert "| ours | 12.3 | – |\n| paper | 195 | text |" in text
    assert text.startswith("## Title\n\nHow.\n\n|  | a | b |\n|---|---|---|\n")
    assert "- said\n" in text and "![seen](a.png)" in text


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="row of 1 cells"):
        Table("T", "c", ["a", "b"], [["x"]]).markdown()


def test_cells_have_three_digits_and_their_interval():
    assert cell(Estimate(1234.6, 1200.2, 1300.0, 48, 12)) == "1235 [1200, 1300] (n = 48 in 12)"
    assert cell(Estimate(0.03456, math.nan, math.nan, 1)) == "0.0346 (n = 1)"
    assert cell(0.0002346) == "0.000235"


@pytest.mark.parametrize("ours, same", [({"a": 1.0, "b": 2.0}, True), ({"a": 2.0, "b": 1.0}, False)])
def test_ordering_knows_which_way_is_better(ours, same):
    assert ordering("FVD", {"a": 10.0, "b": 20.0}, ours)[0] is same
    assert ordering("PSNR", {"a": 20.0, "b": 10.0}, ours)[0] is not same
    assert ("not reproduced" in ordering("LPIPS", {"a": 0.1, "b": 0.2}, ours)[1]) is not same


def test_a_notebook_measures_once_and_keeps_estimates(tmp_path):
    calls = []

    def work():
        calls.append(1)
        return {"x": Estimate(1.0, math.nan, math.nan, 1), "y": [1, 2.5], "z": {"a": Estimate(1.0, 0.5, 2.0, 9, 3)}}

    path = tmp_path / "deep" / "cells.json"
    first = Notebook(path).measured("it", work)
    again = Notebook(path).measured("it", work)
    assert len(calls) == 1
    assert again["z"]["a"] == Estimate(1.0, 0.5, 2.0, 9, 3) == first["z"]["a"]
    assert math.isnan(again["x"].low) and again["y"] == [1, 2.5]


def test_marks_tell_contents_apart(tmp_path):
    marks = []
    for name, content in (("a", b"weights"), ("b", b"weights"), ("c", b"others")):
        (tmp_path / name).write_bytes(content)
        marks.append(mark(tmp_path / name))
    assert marks[0] == marks[1] != marks[2]


def test_without_a_run_the_command_says_how_to_make_one(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    assert tables.main(["steps", "--avatars", "monk", "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "--avatar monk --train --preset small" in error


def test_help_names_every_table(capsys):
    with pytest.raises(SystemExit) as stopped:
        tables.main(["--help"])
    assert stopped.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert all(name in shown for name in typing.get_args(tables.Name))


def test_only_pairs_of_deformers_that_are_told_apart_count_for_the_order():
    rng = np.random.default_rng(0)
    base = rng.normal(size=60)
    worse = base - 1 + 0.05 * rng.normal(size=60)
    found = {"ours": base, "MLP": worse, "vanilla GNN": worse + 0.05 * rng.normal(size=60)}
    takes = {name: [{"PSNR": values.tolist()}] for name, values in found.items()}
    # Printed, the GNN is ahead of ours and both of the MLP.
    assert deformers.order(takes) == "of 3 pairs of methods 2 are told apart, 1 of these in the paper's order"
    apart = deformers.less(takes["ours"], takes["MLP"], "PSNR")
    assert apart.mean == pytest.approx(float((base - worse).mean())) and apart.groups == 10
