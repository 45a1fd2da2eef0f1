"""Shared parts of all reports: whether files can be written, found out before the work; results as JSON; the look.

One page with one style sheet and the pictures inside it, one resolution, one set of colours.
"""

from __future__ import annotations

import base64
import io
import json
import math
import numbers
import os
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from disco_hw.errors import InputError


def refuse_directory(path: Path, names: Iterable[str] = (), inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if a directory cannot be made or written, or if a file of these names in it is an input."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise InputError(f"{path}: exists and is not a directory; give another directory")
    _refuse_place(path)
    for name in names:
        _refuse_input(path / name, inputs)


def refuse_file(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if a file cannot be written, or if it is one of the inputs."""
    if os.path.isdir(path):
        raise InputError(f"{path}: is a directory; give the path of a file")
    _refuse_input(path, inputs)
    _refuse_place(path)


def _refuse_input(path: Path, inputs: Iterable[Path]) -> None:
    for given in inputs:
        if path == given or (os.path.exists(path) and os.path.exists(given) and path.samefile(given)):
            raise InputError(f"{path}: is read here and would be overwritten; give another path")


def _refuse_place(path: Path) -> None:
    """Refuse a path where what is there of it, from the root on, cannot be written."""
    there = path
    while not os.path.exists(there) and there != there.parent:
        there = there.parent
    if there != path and not os.path.isdir(there):
        raise InputError(f"{path}: {there} is not a directory; give another path")
    if not os.access(there, os.W_OK):
        raise InputError(f"{path}: {there} cannot be written to; give another path")


def as_json(result: Mapping[str, Any], indent: int | None = None) -> str:
    """Return a result as one JSON object; infinity and NaN, which JSON does not know, become null.

    Scalars and arrays of numpy are written as the numbers they are. Raises TypeError for what JSON has no word for.
    """
    return json.dumps(_plain(result), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return the value in the types that `json` knows.

    Numpy is recognised by its methods, as importing it takes long.
    """
    match value:
        case bool() | str() | None:
            return value
        case numbers.Integral():
            return int(value)
        case numbers.Real():
            return float(value) if math.isfinite(value) else None
        case Mapping():
            return {_plain(key): _plain(one) for key, one in value.items()}
        case list() | tuple():
            return [_plain(one) for one in value]
        case _ if hasattr(value, "tolist"):
            return _plain(value.tolist())
        case _:
            return value


if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Chosen: sharp on a screen, and small in a report.
DPI = 110
MAIN, ALARM, REFERENCE, BASELINE, FLOOR = "#2f7fc1", "#c0392b", "#b0b0b0", "#d98c3f", "#60a060"
"""Colours of what a picture is about, what is wrong, what it started from, the next best, and what noise leaves."""

_STYLE_SHEET = """
body{font:15px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
.answer{font-size:1.2rem;background:#f2f6fa;border-left:4px solid #2f7fc1;padding:.8rem 1rem}.answer p{margin:.2rem 0}
.warn{border-left:4px solid #c0392b;padding-left:.8rem}
table{border-collapse:collapse;margin:.6rem 0}td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #ddd}
td.n{text-align:right;font-variant-numeric:tabular-nums}img{max-width:100%}
aside{float:right;width:14rem;margin:0 0 1rem 1.5rem;font-size:.85rem;color:#444;background:#fafafa;padding:0 .8rem}
dt{font-weight:600}dd{margin:0 0 .3rem}details{margin:.5rem 0;overflow-x:auto}summary{cursor:pointer;font-weight:600}
figure{margin:1.2rem 0;overflow:hidden}figcaption{color:#555;font-size:.9rem}h2{margin-top:2rem}
"""


def page(title: str, body: str) -> str:
    """Return a self-contained HTML page under its title; `body` is HTML."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE_SHEET}</style></head><body><h1>{escape(title)}</h1>{body}</body></html>"
    )


def picture(data: bytes, name: str, caption: str = "") -> str:
    """Return a PNG's bytes as HTML, with a text for who cannot see it and a caption, if any, below."""
    encoded = base64.b64encode(data).decode("ascii")
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(name)}" src="data:image/png;base64,{encoded}">{below}</figure>'


def png(figure: Figure) -> bytes:
    """Return a figure as a PNG's bytes, cut to what is drawn."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, bbox_inches="tight")
    return buffer.getvalue()


TWO_THIRDS = (1.0 / 6.0, 5.0 / 6.0)
"""Quantiles between which two thirds of the seeds lie."""


def write_pictures(figure: Figure, path: Path) -> None:
    """Write a figure to a PNG file, and to a PDF and an SVG file beside it. Raises OSError."""
    write_png(figure, path)
    figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
    figure.savefig(path.with_suffix(".svg"), metadata={"Date": None})


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure to a PNG file. Raises OSError."""
    path.write_bytes(png(figure))
