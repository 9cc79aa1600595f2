"""One self-contained report.html: headings, text, tables, pictures and videos, readable without a server."""

from __future__ import annotations

import base64
import html
import math
import os
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from avatarjax.io import atomic

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1080px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.7em } h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: 1em 0 } caption { text-align: left; color: #555; padding-bottom: .3em }
th, td { padding: .25em .8em; border-bottom: 1px solid #e5e5e5; text-align: right }
th:first-child, td:first-child { text-align: left } th { background: #f6f6f6 }
tr.good td:last-child { color: #17702a } tr.bad td:last-child { color: #a61b1b }
img, video { max-width: 100% } figure { margin: 1em 0 } figcaption { color: #555; font-size: .92em }
pre { background: #f6f6f6; padding: .8em; overflow-x: auto }
"""
_MEDIA = {".png": "image/png", ".mp4": "video/mp4"}


class Report:
    """Collects sections in order; `write` makes the page."""

    def __init__(self, title: str):
        self.title = title
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        """Start a section."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

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
        """A table; floats get four significant digits, None a dash. `verdicts` colours the last cell of each row."""
        head = "".join(f"<th>{html.escape(c)}</th>" for c in columns)
        body = []
        for k, row in enumerate(rows):
            verdict = verdicts[k] if verdicts else None
            kind = "" if verdict is None else f' class="{"good" if verdict else "bad"}"'
            body.append(f"<tr{kind}>" + "".join(f"<td>{html.escape(_cell(x))}</td>" for x in row) + "</tr>")
        self._parts.append(f"<table><caption>{html.escape(caption)}</caption><tr>{head}</tr>{''.join(body)}</table>")

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
        self._parts.append(f"<figure>{element}<figcaption>{html.escape(caption)}</figcaption></figure>")

    def write(self, path: str | os.PathLike) -> None:
        """Write the page atomically."""
        title = html.escape(self.title)
        page = (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
            f"<h1>{title}</h1>{''.join(self._parts)}</html>\n"
        )
        atomic.write_text(path, page)


def _cell(value: typing.Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, (float, np.floating)):
        return "not finite" if not math.isfinite(value) else f"{value:.4g}"
    return str(value)
