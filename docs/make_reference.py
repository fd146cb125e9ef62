"""Writes docs/reference/api.md from the docstrings of `ast_sim.__all__`, and commands.md from the help of `ast-sim`."""

from __future__ import annotations

import argparse
import enum
import functools
import inspect
import os
import re
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.cli import build_parser

FOLDER = Path(__file__).parent / "reference"
WIDTH = 100
NOTE = "<!-- Written by `make docs` from the sources: change it there. -->"
SECTION = re.compile(r"(Args|Attributes|Returns|Yields|Raises):")
ENTRY = re.compile(r"([\w.*]+(?:, [\w.*]+)*): ")  # of an argument, several of one meaning, or an error


def api() -> str:
    """The page of the Python interface."""
    names = getattr(ast_sim, "__all__", None) or dir(ast_sim)
    public = [(name, getattr(ast_sim, name)) for name in sorted(names, key=str.lower) if not name.startswith("_")]
    parts = [f"# Python: `import ast_sim`\n\n{NOTE}"]
    for name, value in public:
        if not inspect.ismodule(value):
            parts += [f"## `ast_sim.{name}`", *described(name, value)]
    return "\n\n".join(part for part in parts if part) + "\n"


def described(name: str, value: Any) -> list[str]:
    """Signature and docstring of a function or a class, and of its public members."""
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        return [f"A `{type(value).__name__}`."]
    parts = [signature(name, value), markdown(inspect.getdoc(value) or "")]
    for member, inner in vars(value).items() if inspect.isclass(value) else ():
        inner = inner.__func__ if isinstance(inner, classmethod | staticmethod) else inner
        if member.startswith("_") or not getattr(inner, "__doc__", None):
            continue
        if isinstance(inner, property | functools.cached_property):
            parts += [f"### `{name}.{member}`", markdown(inspect.getdoc(inner) or "")]
        elif inspect.isfunction(inner):
            parts += [f"### `{name}.{member}()`", *described(member, inner)]
    return parts


def signature(name: str, value: Any) -> str:
    """As it stands in the source, a parameter a line where it is long; the members of an enumeration."""
    if inspect.isclass(value) and issubclass(value, enum.Enum):
        text = "\n".join(f"{name}.{member.name} = {member.value!r}" for member in value)
    elif inspect.isclass(value) and issubclass(value, Exception):
        return ""
    else:
        found = inspect.signature(value)
        parts: list[str] = []
        for parameter in (p for p in found.parameters.values() if p.name != "self"):
            if parameter.kind is parameter.KEYWORD_ONLY and not any(part.startswith("*") for part in parts):
                parts.append("*")
            default = Bare("...") if "<" in repr(parameter.default) else parameter.default  # no addresses of objects
            default = parameter.empty if parameter.default is parameter.empty else default
            parts.append(str(parameter.replace(annotation=bare(parameter.annotation), default=default)))
        result = found.empty if inspect.isclass(value) else bare(found.return_annotation)
        text = str(found.replace(parameters=[], return_annotation=result)).removeprefix("()")
        short = f"{name}({', '.join(parts)}){text}"
        text = short if len(short) <= WIDTH else "\n    ".join([f"{name}(", *(f"{p}," for p in parts)]) + f"\n){text}"
    return f"```py\n{text}\n```"  # not "python": that is what the tests of the pages run


class Bare(str):
    """A text that shows without quotes."""

    __repr__ = str.__str__


def bare(annotation: Any) -> Any:
    """An annotation that is kept as text, as it stands in the source; the ones of a `NamedTuple` are `ForwardRef`s."""
    annotation = getattr(annotation, "__forward_arg__", annotation)
    return Bare(annotation) if isinstance(annotation, str) else annotation


def markdown(doc: str) -> str:
    """A docstring with its sections as headed lists."""
    lines: list[str] = []
    section = ""
    for line in doc.splitlines():
        if found := SECTION.fullmatch(line):
            section = found[1]
            lines += [f"**{section}**", ""]
            continue
        if line and not line.startswith(" "):
            section = ""
        inner = line.removeprefix("    ") if section else line
        if section and section != "Returns" and (found := ENTRY.match(inner)):
            inner = f"- `{found[1]}`: {inner[found.end() :]}"
        elif section:
            inner = f"  {inner.strip()}" if inner.startswith(" ") else inner
        lines.append(inner)
    return "\n".join(lines).strip()


def commands() -> str:
    """The page of the command line."""
    os.environ |= {"COLUMNS": str(WIDTH + 2), "NO_COLOR": "1"}  # argparse leaves two columns free
    parser = build_parser()
    (choices,) = (action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    parts = ["# Commands: `ast-sim`", NOTE]
    for name, command in {"": parser, **choices}.items():
        title = f"ast-sim {name}".strip()
        parts += [f"## `{title}`", f"```text\n{command.format_help().rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"


PAGES = {"api.md": api, "commands.md": commands}

if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for page, write in PAGES.items():
        (FOLDER / page).write_text(write(), encoding="utf-8")
