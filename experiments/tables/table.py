"""A table with pictures and a word on the paper's ordering, as Markdown; and a memory of measured cells."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from avatarjax.io import atomic
from avatarjax.metrics.published import Published
from avatarjax.metrics.statistics import Estimate

BETTER = {"FVD": min, "PSNR": max, "SSIM": max, "LPIPS": min}


@dataclasses.dataclass
class Table:
    """Rows under columns; cells are text, numbers, `Estimate`s or `Published` numbers."""

    title: str
    caption: str
    columns: Sequence[str]
    rows: list[Sequence[typing.Any]]
    remarks: list[str] = dataclasses.field(default_factory=list)
    pictures: list[tuple[str, str]] = dataclasses.field(default_factory=list)  # file name, what it shows

    def markdown(self) -> str:
        """The table as GitHub shows it. Raises ValueError for rows of another length than `columns`."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells does not fit the columns {list(self.columns)}")
        lines = [f"## {self.title}", "", self.caption, ""]
        if self.rows:
            lines += ["| " + " | ".join(self.columns) + " |", "|---" * len(self.columns) + "|"]
            lines += ["| " + " | ".join(map(cell, row)) + " |" for row in self.rows] + [""]
        lines += [f"- {remark}" for remark in self.remarks] + [""] * bool(self.remarks)
        lines += [line for name, shows in self.pictures for line in (f"![{shows}]({name})", "")]
        return "\n".join(lines)


def cell(value: typing.Any) -> str:
    """Three significant digits and at least whole numbers; an interval in brackets with its n; a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, Published):
        value = value.value
    if isinstance(value, Estimate):
        known = not math.isnan(value.low)
        interval = f" [{number(value.low)}, {number(value.high)}]" if known else ""
        return f"{number(value.mean)}{interval} (n = {value.count})"
    return number(value) if isinstance(value, float) else str(value)


def number(value: float) -> str:
    """Three significant digits, whole numbers kept."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def ordering(
    metric: str, paper: Mapping[typing.Any, float], ours: Mapping[typing.Any, float | Estimate]
) -> tuple[bool, str]:
    """Whether the same entry is best by a metric in the paper and here, and a sentence that says so."""
    means = {k: v.mean if isinstance(v, Estimate) else v for k, v in ours.items()}
    best = BETTER[metric](paper, key=paper.__getitem__), BETTER[metric](means, key=means.__getitem__)
    same = best[0] == best[1]
    return same, f"{metric}: best in the paper {best[0]}, here {best[1]} ({'the same' if same else 'not reproduced'})."


class Notebook:
    """Measured cells by name in a JSON file, so that a table that was interrupted goes on where it was."""

    def __init__(self, path: Path):
        self.path = path
        self._cells: dict[str, typing.Any] = json.loads(path.read_text()) if path.is_file() else {}

    def measured(self, name: str, work: Callable[[], typing.Any]) -> typing.Any:
        """What `work()` returned when it was first asked for `name`: numbers, text, `Estimate`s, dicts and lists."""
        if name not in self._cells:
            print(f"measuring {name}", flush=True)
            self._cells[name] = _plain(work())
            self.path.parent.mkdir(parents=True, exist_ok=True)
            atomic.write_text(self.path, json.dumps(self._cells, indent=1))
        return _rich(self._cells[name])


def mark(path: Path) -> str:
    """A short name of what a file holds, which tells cells that were measured on it from those of another."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:8]


_ESTIMATE = set(Estimate._fields)


def _plain(value: typing.Any) -> typing.Any:
    if isinstance(value, Estimate):
        return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in value._asdict().items()}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def _rich(value: typing.Any) -> typing.Any:
    if isinstance(value, dict):
        if set(value) == _ESTIMATE:
            low, high = (math.nan if value[k] is None else value[k] for k in ("low", "high"))
            return Estimate(**{**value, "low": low, "high": high})
        return {k: _rich(v) for k, v in value.items()}
    return [_rich(v) for v in value] if isinstance(value, list) else value
