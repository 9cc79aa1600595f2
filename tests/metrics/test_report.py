import base64
import html.parser
import platform
import subprocess
from pathlib import Path

import numpy as np
import pytest

from avatarjax.io import exr
from avatarjax.metrics import environment, published
from avatarjax.metrics.report import Report, draw_band
from avatarjax.metrics.statistics import Estimate

VOID = {"meta", "img", "br"}


class Page(html.parser.HTMLParser):
    """Tags with their attributes, and all text, of a page; it fails where tags are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.cells, self.heads, self.words, self.inside, self.open = [], [], [], [], "", []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.inside = tag
        assert len(dict(attributes)) == len(attributes), f"{tag} has an attribute twice"
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        self.inside = ""
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self.inside == "td":
            self.cells.append(data)
        if self.inside == "th":
            self.heads.append(data)

    def named(self, name):
        return [attributes for tag, attributes in self.tags if tag == name]


def written(report, folder):
    report.write(folder / "report.html")
    return Page((folder / "report.html").read_text(encoding="utf-8"))


EVIL = '<script>alert("&")</script>'


def test_text_is_never_markup(tmp_path):
    exr.write_png(tmp_path / "dot.png", np.zeros((1, 1, 3), np.uint8))
    report = Report(EVIL)
    for add in (report.heading, report.text, report.code):
        add(EVIL)
    report.heading(EVIL)
    report.table(EVIL, [EVIL], [[EVIL]])
    report.media(tmp_path / "dot.png", EVIL)
    report.plot(lambda axes: axes.set_title(EVIL), EVIL)
    page = written(report, tmp_path)
    assert not page.named("script")
    # Title twice, four texts, two links, caption, column, cell, two figure captions, title of the plot.
    assert page.words.count(EVIL) == 14
    assert page.named("img")[0]["alt"] == EVIL


@pytest.mark.parametrize("suffix, tag, kind", [(".png", "img", "image/png"), (".mp4", "video", "video/mp4")])
def test_media_are_embedded_byte_for_byte(tmp_path, suffix, tag, kind):
    content = bytes(range(256))
    (tmp_path / f"file{suffix}").write_bytes(content)
    report = Report("t")
    report.media(tmp_path / f"file{suffix}", "caption")
    head, data = written(report, tmp_path).named(tag)[0]["src"].split(",")
    assert head == f"data:{kind};base64" and base64.b64decode(data) == content


def test_other_media_are_refused(tmp_path):
    (tmp_path / "a.svg").write_text("<svg/>")
    with pytest.raises(ValueError, match=r"\.png, \.mp4 files, not .*a\.svg"):
        Report("t").media(tmp_path / "a.svg", "")


def test_cells_are_short_and_honest(tmp_path):
    report = Report("t")
    row = [1 / 3, np.float32(1 / 3), None, float("nan"), np.float32(np.inf), 12345678, "x"]
    report.table("c", list("abcdefg"), [row])
    cells = written(report, tmp_path).cells
    assert cells == ["0.3333", "0.3333", "–", "not finite", "not finite", "12345678", "x"]


def test_verdicts_mark_their_rows(tmp_path):
    report = Report("t")
    report.table("c", ["a"], [[1], [2], [3]], verdicts=[True, None, False])
    assert [row.get("class") for row in written(report, tmp_path).named("tr")[1:]] == ["good", None, "bad"]


def test_sections_keep_their_order(tmp_path):
    report = Report("t")
    report.heading("one")
    report.text("two")
    report.code("three")
    words = written(report, tmp_path).words
    assert [w for w in words if w in ("one", "two", "three")] == ["one", "two", "three"]


def test_the_page_needs_no_other_file(tmp_path):
    exr.write_png(tmp_path / "dot.png", np.zeros((1, 1, 3), np.uint8))
    report = Report("t")
    report.heading("one")
    report.heading("two")
    report.media(tmp_path / "dot.png", "")
    report.plot(lambda axes: axes.plot([0, 1], [0, 1], "o-", label="line"), "")
    page = written(report, tmp_path)
    for _, attributes in page.tags:
        assert "data" not in attributes
        assert attributes.get("href", "#").startswith("#") and attributes.get("xlink:href", "#").startswith("#")
        assert attributes.get("src", "data:").startswith("data:")


def test_every_link_leads_to_its_heading_and_no_name_is_used_twice(tmp_path):
    report = Report("t")
    for text in ("one", "two", "one"):
        report.heading(text)
        report.plot(lambda axes: axes.plot([0, 1], [0, 1], "o-"), "")
    page = written(report, tmp_path)
    assert [a["href"] for a in page.named("a")] == ["#" + h["id"] for h in page.named("h2")]
    names = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(names) == len(set(names))


def test_a_page_of_one_section_has_no_contents(tmp_path):
    report = Report("t")
    report.heading("one")
    assert not written(report, tmp_path).named("nav")


class TestEstimates:
    ESTIMATE = Estimate(12.0, 11.0, 13.0, 30)

    def test_they_have_their_interval_and_a_column_n_after_the_last_of_them(self, tmp_path):
        report = Report("t")
        report.table("c", ["what", "ours", "verdict"], [["x", self.ESTIMATE, "good"], ["y", 3.0, "bad"]])
        page = written(report, tmp_path)
        assert page.heads == ["what", "ours", "n", "verdict"]
        assert page.cells == ["x", "12 [11, 13]", "30", "good", "y", "3", "–", "bad"]

    def test_a_table_with_its_own_n_keeps_it(self, tmp_path):
        report = Report("t")
        report.table("c", ["ours", "n"], [[self.ESTIMATE, "all"]])
        assert written(report, tmp_path).cells == ["12 [11, 13]", "all"]

    def test_where_a_row_differs_in_n_each_cell_says_its_own(self, tmp_path):
        report = Report("t")
        report.table("c", ["a", "b"], [[self.ESTIMATE, self.ESTIMATE._replace(n=7, groups=3)]])
        assert written(report, tmp_path).cells == ["12 [11, 13] (n = 30)", "12 [11, 13] (n = 7 in 3)", "–"]

    def test_one_value_has_no_interval(self, tmp_path):
        report = Report("t")
        report.table("c", ["a"], [[Estimate(2.0, float("nan"), float("nan"), 1)]])
        assert written(report, tmp_path).cells == ["2 [not known]", "1"]


@pytest.mark.parametrize(
    "rows, verdicts, message", [([[1, 2]], None, "2 cells does not fit the 1 columns"), ([[1]], [], "1 rows need")]
)
def test_tables_that_do_not_fit_are_refused(rows, verdicts, message):
    with pytest.raises(ValueError, match=message):
        Report("t").table("c", ["a"], rows, verdicts=verdicts)


def test_a_comparison_says_where_the_papers_number_is_from(tmp_path):
    report = Report("t")
    report.comparison(
        "c", [("turning", Estimate(14.0, 12.0, 16.0, 5), published.UNICA_D_TURNS.at("UNICA", "90 degrees"))]
    )
    page = written(report, tmp_path)
    assert page.heads == ["ours", "n", "paper", "source"]
    assert page.cells == ["turning", "14 [12, 16]", "5", "9.84", "UNICA Table D and D.4"]


def test_plots_keep_their_text_and_follow_the_pages_colour(tmp_path, caplog):
    def draw(axes):
        line = np.arange(4.0)
        draw_band(axes, np.arange(4), line, line - 1, line + 1, "trend")
        axes.set_xlabel("frame < 4")
        axes.legend()

    report = Report("t")
    report.plot(draw, "caption")
    page = written(report, tmp_path)
    assert {"trend", "frame < 4", "caption"} <= set(page.words)
    text = (tmp_path / "report.html").read_text()
    assert not caplog.records
    assert "currentColor" in text and "#000000" not in text and "<?xml" not in text


def test_the_same_report_is_written_twice_the_same(tmp_path):
    pages = []
    for _ in range(2):
        report = Report("t")
        report.plot(lambda axes: axes.plot([1, 2], [3, 4]), "c")
        written(report, tmp_path)
        pages.append((tmp_path / "report.html").read_bytes())
    assert pages[0] == pages[1]


class TestEnvironment:
    def test_the_report_has_command_versions_and_times(self, tmp_path):
        report = Report("t")
        report.environment("python -m experiments.x --seed 3", {"data": 1.5, "vae": 2.0})
        page = written(report, tmp_path)
        assert "python -m experiments.x --seed 3" in page.words
        assert {"jax, jaxlib", "backend", "date", "commit"} <= set(page.cells)
        assert page.cells[-6:] == ["data", "1.5", "vae", "2", "together", "3.5"]

    def test_it_names_neither_machine_nor_folders(self):
        values = " ".join(environment.describe().values())
        assert platform.node() not in values and str(Path.home()) not in values

    def test_a_package_outside_a_clone_has_no_commit(self, tmp_path):
        assert environment._commit(tmp_path) is None

    def test_a_package_inside_anothers_clone_has_no_commit(self, tmp_path):
        (tmp_path / "environment.py").write_text("")
        subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
        assert environment._commit(tmp_path) is None
