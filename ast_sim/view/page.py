"""One self-contained HTML page: the template with its styles, scripts, plotly and data all inside.

The page needs no network. Its content security policy lets a browser run only these scripts and load nothing.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from importlib import resources
from pathlib import Path
from typing import Any

from ast_sim.support.argument_checks import file_name
from ast_sim.support.disk import replacing
from ast_sim.support.errors import AstSimError, require
from ast_sim.view.files import explained

SCRIPTS = ("common.js", "panel.js", "viewer.js", "charts.js", "gallery.js", "dataset.js", "trade.js", "page.js")
SUFFIXES = (".html", ".htm")
FOOTER = "Made by ast_sim. This page is one file and loads nothing from anywhere."


def page_name(path: str | os.PathLike[str]) -> Path:
    """The name of a page as a path.

    Raises:
        AstSimError: the name does not say that it is HTML.
    """
    name = file_name(path, "path")
    if name.suffix.lower() not in SUFFIXES:
        raise AstSimError(f"{path}: the name of a page must end in {' or '.join(SUFFIXES)}")
    return name


def write(path: str | os.PathLike[str], data: dict[str, Any], title: str) -> None:
    """Write the page that shows `data`. No half-written file is ever left under the name.

    Raises:
        AstSimError: the suffix is neither .html nor .htm, or the file cannot be written.
        MissingExtra: plotly is not installed.
    """
    path = page_name(path)
    text = render(data, title)
    with explained(path), replacing(path) as temporary:
        # Names of files may hold bytes that are no text; their escapes are valid in JSON, too.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def render(data: dict[str, Any], title: str) -> str:
    """The text of the page. `data` is JSON without NaN; the scripts show what it has and hide what it lacks."""
    (offline,) = require("view", "plotly.offline")
    plotly = offline.get_plotlyjs()
    script = '"use strict";\n(() => {\n' + "\n".join(_template(name) for name in SCRIPTS) + "})();\n"
    policy = (
        "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
        f"script-src {_digest(plotly)} {_digest(script)}; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "title": html.escape(title),
        "policy": policy,
        "style": _template("page.css"),
        "data": _json(data),
        "plotly": plotly,
        "script": script,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _template("page.html"))


def _template(name: str) -> str:
    return resources.files("ast_sim.view").joinpath("assets", name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    """The source expression of a content security policy that allows this very script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _json(data: Any) -> str:
    """JSON that may stand in a script element: no "<", so nothing inside can end the element or open another."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
