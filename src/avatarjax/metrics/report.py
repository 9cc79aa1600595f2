"""One self-contained report.html: headings, text, tables, plots, pictures and videos, readable without a server."""

from __future__ import annotations

import base64
import html
import io
import math
import os
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real

from avatarjax.io import atomic
from avatarjax.metrics import environment
from avatarjax.metrics.published import Published
from avatarjax.metrics.statistics import Estimate

_STYLE = """
:root { color-scheme: light dark; --text: #1d2330; --soft: #5d6778; --line: #dfe3ea; --card: #f5f7fa;
  --page: #fff; --link: #1d5fbf; --good: #17702a; --bad: #b3261e }
@media (prefers-color-scheme: dark) { :root { --text: #e4e8ef; --soft: #9aa5b6; --line: #333c4a; --card: #1e2530;
  --page: #151a22; --link: #7fb2ff; --good: #6fcf87; --bad: #ff8a80 } }
body { font: 16px/1.55 system-ui, sans-serif; color: var(--text); background: var(--page); max-width: 1080px;
  margin: 2em auto 4em; padding: 0 1.2em }
h1 { font-size: 1.8em; line-height: 1.2; margin: .5em 0 }
h2 { font-size: 1.3em; margin: 2.2em 0 .6em; padding-bottom: .25em; border-bottom: 1px solid var(--line) }
a { color: var(--link); text-decoration: none } a:hover { text-decoration: underline }
nav ul { list-style: none; display: flex; flex-wrap: wrap; gap: .3em 1.3em; margin: 1em 0; padding: .7em 1em;
  background: var(--card); border-radius: 8px }
.wide { overflow-x: auto; margin: 1.2em 0 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .94em }
caption { text-align: left; color: var(--soft); padding-bottom: .5em; max-width: 70em }
th, td { padding: .35em .9em; border-bottom: 1px solid var(--line); text-align: right }
td { white-space: nowrap } th:first-child, td:first-child { text-align: left; white-space: normal; min-width: 7em }
table { min-width: min(100%, 34em) } th { background: var(--card); font-weight: 600 }
tr.good td:last-child { color: var(--good) } tr.bad td:last-child { color: var(--bad) }
figure { margin: 1.4em 0 } figcaption { color: var(--soft); font-size: .92em; margin-top: .4em }
img, video, figure svg { max-width: 100%; height: auto; border-radius: 6px } img, video { background: #fff }
video { min-width: min(100%, 40em) } figure svg text { fill: currentColor; font-family: inherit !important }
pre { background: var(--card); padding: .9em 1.1em; overflow-x: auto; border-radius: 8px; font-size: .88em }
"""
_MEDIA = {".png": "image/png", ".mp4": "video/mp4"}
_PLOT = {
    "svg.fonttype": "none",
    "font.size": 11,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}


class Report:
    """Collects sections in order; `write` makes the page."""

    def __init__(self, title: str):
        self.title = title
        self._parts: list[str] = []
        self._headings: list[str] = []
        self._plots = 0

    def heading(self, text: str) -> None:
        """Start a section; the top of the page links to it."""
        self._headings.append(text)
        self._parts.append(f'<h2 id="section-{len(self._headings)}">{html.escape(text)}</h2>')

    def text(self, text: str) -> None:
        """A paragraph."""
        self._parts.append(f"<p>{html.escape(text)}</p>")

    def code(self, text: str) -> None:
        """Preformatted text, such as a command or a config."""
        self._parts.append(f"<pre>{html.escape(text)}</pre>")

    def table(
        self,
        caption: str,
        columns: Sequence[str],
        rows: Sequence[Sequence[typing.Any]],
        *,
        verdicts: Sequence[bool | None] | None = None,
    ) -> None:
        """A table; floats get four significant digits, None a dash, an `Estimate` its interval and a column n.

        The column n stands after the last column of estimates unless the table has its own; where the estimates of a
        row differ in n, each cell says its own. `verdicts` colours the last cell of each row. Raises ValueError for
        rows of another length than `columns`, or another number of verdicts than rows.
        """
        for row in rows:
            if len(row) != len(columns):
                raise ValueError(f"a row of {len(row)} cells does not fit the {len(columns)} columns {list(columns)}")
        if verdicts is not None and len(verdicts) != len(rows):
            raise ValueError(f"{len(rows)} rows need as many verdicts, got {len(verdicts)}")
        columns, rows = _counted(list(columns), [list(row) for row in rows])
        head = "".join(f"<th>{html.escape(c)}</th>" for c in columns)
        body = []
        for k, row in enumerate(rows):
            verdict = verdicts[k] if verdicts else None
            kind = "" if verdict is None else f' class="{"good" if verdict else "bad"}"'
            body.append(f"<tr{kind}>" + "".join(f"<td>{html.escape(_cell(x))}</td>" for x in row) + "</tr>")
        self._parts.append(
            f'<div class="wide"><table><caption>{html.escape(caption)}</caption>'
            f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
        )

    def comparison(self, caption: str, rows: Sequence[tuple[str, typing.Any, Published]]) -> None:
        """A table of our numbers beside those a paper prints: rows of (what, ours, the `published` number)."""
        self.table(
            caption, ["", "ours", "paper", "source"], [(what, ours, p.value, p.source) for what, ours, p in rows]
        )

    def environment(self, command: str, seconds: Mapping[str, float] | None = None) -> None:
        """A section that says by what command, on what and when this was made, and how long each stage took."""
        self.heading("Environment")
        self.code(command)
        self.table("What this ran on", ["", "value"], list(environment.describe().items()))
        if seconds:
            rows = [(stage, float(taken)) for stage, taken in seconds.items()]
            self.table("Time taken", ["stage", "seconds"], [*rows, ("together", float(sum(seconds.values())))])

    def media(self, path: str | os.PathLike, caption: str) -> None:
        """A PNG picture or an mp4 video, embedded. Raises ValueError for another kind of file."""
        path = Path(path)
        if path.suffix not in _MEDIA:
            raise ValueError(f"a report shows {', '.join(_MEDIA)} files, not {path}")
        kind = _MEDIA[path.suffix]
        data = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
        if kind.startswith("video"):
            element = f'<video src="{data}" controls loop autoplay muted></video>'
        else:
            element = f'<img src="{data}" alt="{html.escape(caption)}">'
        self._figure(element, caption)

    def plot(self, draw: Callable[[typing.Any], None], caption: str, *, size: tuple[float, float] = (8.0, 4.0)) -> None:
        """A matplotlib figure of `size` inches that `draw(axes)` fills in, embedded as SVG.

        Text stays text, and black follows the page's own colour, light or dark.
        """
        import matplotlib
        from matplotlib.figure import Figure

        self._plots += 1
        with matplotlib.rc_context({**_PLOT, "svg.hashsalt": f"plot-{self._plots}"}):
            figure = Figure(figsize=size, layout="constrained")
            draw(figure.subplots())
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        self._figure(_inline(buffer.getvalue(), f"plot{self._plots}-"), caption)

    def write(self, path: str | os.PathLike) -> None:
        """Write the page atomically."""
        title = html.escape(self.title)
        links = "".join(
            f'<li><a href="#section-{k}">{html.escape(text)}</a></li>' for k, text in enumerate(self._headings, start=1)
        )
        contents = f"<nav><ul>{links}</ul></nav>" if len(self._headings) > 1 else ""
        page = (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{title}</title><style>{_STYLE}</style></head>"
            f"<body><h1>{title}</h1>{contents}{''.join(self._parts)}</body></html>\n"
        )
        atomic.write_text(path, page)

    def _figure(self, element: str, caption: str) -> None:
        self._parts.append(f"<figure>{element}<figcaption>{html.escape(caption)}</figcaption></figure>")


def draw_band(
    axes: typing.Any,
    x: Real[np.ndarray, " n"],
    line: Float[np.ndarray, " n"],
    lower: Float[np.ndarray, " n"],
    upper: Float[np.ndarray, " n"],
    label: str,
    *,
    color: str = "tab:red",
) -> None:
    """A dashed line with a shaded band around it, such as a `drift.trend` with its confidence band."""
    axes.fill_between(x, lower, upper, color=color, alpha=0.25, lw=0)
    axes.plot(x, line, "--", color=color, lw=1.5, label=label)


def _counted(columns: list[str], rows: list[list]) -> tuple[list[str], list[list]]:
    """The table with its column n, if there are estimates in it."""
    places = [k for k in range(len(columns)) if any(isinstance(row[k], Estimate) for row in rows)]
    if not places or "n" in columns:
        return columns, rows
    after, counted = places[-1] + 1, []
    for row in rows:
        counts = {row[k].count for k in places if isinstance(row[k], Estimate)}
        several = len(counts) > 1
        cells = [f"{_cell(x)} (n = {x.count})" if several and isinstance(x, Estimate) else x for x in row]
        counted.append([*cells[:after], next(iter(counts)) if len(counts) == 1 else None, *cells[after:]])
    return [*columns[:after], "n", *columns[after:]], counted


def _cell(value: typing.Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, Estimate):
        known = math.isfinite(value.low)
        return str(value) if known else f"{value.mean:.4g} [not known]"
    if isinstance(value, (float, np.floating)):
        return "not finite" if not math.isfinite(value) else f"{value:.4g}"
    return str(value)


def _inline(svg: str, prefix: str) -> str:
    """An SVG document as an element of the page: its ids made unique, its black the page's text colour."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|xlink:href="#)', lambda m: m[1] + prefix, svg)
    return svg.replace("#000000", "currentColor").strip()
