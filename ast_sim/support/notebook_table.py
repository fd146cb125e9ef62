"""How an object shows itself: one line of text at a prompt, a table in a notebook."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from ast_sim.support.errors import printable

MOST_BARS = 100  # of a drawing


def one_line(kind: str, facts: Mapping[str, Any]) -> str:
    """Such as "Scene(bodies: 2, nodes: 351)"."""
    return f"{kind}({', '.join(f'{key}: {printable(str(value))}' for key, value in facts.items())})"


def html_table(title: str, facts: Mapping[str, Any], picture: str = "") -> str:
    """A table of facts in HTML, and a picture (HTML) beside it; titles and facts are texts, not HTML."""
    left = 'style="text-align:left"'
    shown = {escape(key): escape(printable(str(value))) for key, value in facts.items()}
    rows = "".join(f"<tr><th {left}>{key}</th><td {left}>{value}</td></tr>" for key, value in shown.items())
    table = f"<table><caption><b>{escape(title)}</b></caption><tbody>{rows}</tbody></table>"
    if not picture:
        return table
    return f'<div style="display:flex;align-items:center;gap:1em"><div>{table}</div><div>{picture}</div></div>'


def html_bars(values: Sequence[float], title: str) -> str:
    """Bars in SVG of the last `MOST_BARS` values, the highest 100 pixels high, with a title; empty without values."""
    if not values:
        return ""
    shown = values[-MOST_BARS:]
    largest = max(shown) or 1.0
    heights = [round(100 * value / largest, 1) for value in shown]
    bars = "".join(
        f'<rect x="{8 * place}" y="{100 - height:g}" width="6" height="{height:g}" fill="#4c8bc9"/>'
        for place, height in enumerate(heights)
    )
    return f'<div>{escape(title)}</div><svg width="{8 * len(heights)}" height="100">{bars}</svg>'


def html_picture(png: bytes, width: int) -> str:
    """A PNG as HTML, `width` pixels wide."""
    return f'<img width="{width}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
