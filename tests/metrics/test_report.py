import base64
import html.parser

import numpy as np
import pytest

from avatarjax.io import exr
from avatarjax.metrics.report import Report


class Page(html.parser.HTMLParser):
    """Tags with their attributes, and all text, of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.cells, self.words, self.inside = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.inside = tag

    def handle_endtag(self, tag):
        self.inside = ""

    def handle_data(self, data):
        self.words.append(data)
        if self.inside == "td":
            self.cells.append(data)

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
    report.table(EVIL, [EVIL], [[EVIL]])
    report.media(tmp_path / "dot.png", EVIL)
    page = written(report, tmp_path)
    assert not page.named("script")
    assert page.words.count(EVIL) == 9  # title twice, three texts, caption, column, cell, figure caption
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
    report.table("c", ["a"], [[1 / 3, np.float32(1 / 3), None, float("nan"), np.float32(np.inf), 12345678, "x"]])
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
    report.media(tmp_path / "dot.png", "")
    for _, attributes in written(report, tmp_path).tags:
        assert not {"href", "data"} & attributes.keys()
        assert attributes.get("src", "data:").startswith("data:")
