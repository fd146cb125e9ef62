"""What the pages tell a reader to type works: Python runs, command lines are ones that `ast-sim` takes.

A page's blocks of Python run one after the other as one program, in a folder of its own. A comment on the line before a
block changes that: `<!-- test: slow -->` for one that takes over a minute, which is compiled only, and what it would
have made, `plates.h5` and the runs `run` and `better`, is there already, but small; `<!-- test: fragment -->` for one
that is no program.
"""

import itertools
import re
import shlex
import shutil
import textwrap
from dataclasses import dataclass
from pathlib import Path

import forked
import pytest

from ast_sim.cli import build_parser, main

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FOLLOWED = ("own-assembly.md",)  # pages with a test of their own, which makes what they need
MARKS = ("slow", "fragment")
SHELLS = ("", "sh", "bash", "shell", "console")

_BLOCK = re.compile(
    r"^(?:<!-- test: (?P<mark>.*?) -->\n+)?^(?P<indent> *)```(?P<kind>\w*)\n(?P<text>.*?)^(?P=indent)```$", re.M | re.S
)
_CALL = re.compile(r"(?:\$ )?(?:ast-sim|(?:torchrun|python) .*-m ast_sim\.cli) ")
_OPERATOR = re.compile(r"2?[|&;<>]")


@dataclass(frozen=True)
class Block:
    """A fenced block: language, mark ("" for none), text, and the line of the page where the text starts."""

    kind: str
    mark: str
    text: str
    line: int


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page."""
    found = []
    for match in _BLOCK.finditer(page):
        text = textwrap.dedent(match["text"])
        found.append(Block(match["kind"], match["mark"] or "", text, page[: match.start("text")].count("\n")))
    return found


def program(found: list[Block]) -> str:
    """The blocks that run as one program, each at the lines that it has on the page."""
    lines: list[str] = []
    for block in found:
        if block.kind == "python" and not block.mark:
            lines += [""] * (block.line - len(lines)) + block.text.splitlines()
    return "\n".join(lines)


def calls_of(found: list[Block]) -> list[list[str]]:
    """The arguments of each call of `ast-sim` in the blocks for a shell."""
    calls = []
    for block in (block for block in found if block.kind in SHELLS):
        for line in re.sub(r"\\\n", " ", block.text).splitlines():
            if found := _CALL.match(line):
                words = shlex.split(line[found.end() :], comments=True)
                calls.append(list(itertools.takewhile(lambda word: not _OPERATOR.match(word), words)))
    return calls


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def with_blocks(kinds: tuple[str, ...]) -> list[Path]:
    return [page for page in PAGES if any(block.kind in kinds for block in blocks(page.read_text(encoding="utf-8")))]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a small `plates.h5`, a `run` that was trained on it for a moment, and the same run as `better`."""
    folder = tmp_path_factory.mktemp("made")
    data, run = str(folder / "plates.h5"), str(folder / "run")
    few = shlex.split("--count 2 --valid 1 --test 1 --nodes 150 --frames 6 --workers 1")
    assert main(["generate", "deforming_plate", "--out", data, *few]) == 0
    settings = ["train.steps=4", "train.statistics_pairs=4", "train.batch_size=2"]
    assert main(["train", data, "--out", run, *(word for setting in settings for word in ("--set", setting))]) == 0
    shutil.copytree(run, folder / "better")
    return folder


@pytest.mark.parametrize("page", [p for p in with_blocks(("python",)) if p.name not in FOLLOWED], ids=page_name)
def test_python_on_a_page_runs(page, tmp_path, request):
    found = blocks(page.read_text(encoding="utf-8"))
    for block in (block for block in found if block.kind == "python"):
        assert block.mark in ("", *MARKS), f"{page_name(page)}: line {block.line}: no such mark: {block.mark}"
        if block.mark != "fragment":
            compile(block.text, f"{page_name(page)}, from line {block.line}", "exec")
    if any(block.mark == "slow" for block in found):
        shutil.copytree(request.getfixturevalue("made"), tmp_path, dirs_exist_ok=True)
    script = tmp_path / "page.py"
    script.write_text(program(found), encoding="utf-8")
    done = forked.run([script.name], cwd=tmp_path)
    assert done.returncode == 0, f"{page_name(page)}, whose lines these are:\n{done.stderr}"


@pytest.mark.parametrize("page", with_blocks(SHELLS), ids=page_name)
def test_commands_on_a_page_are_taken(page, capsys):
    for call in calls_of(blocks(page.read_text(encoding="utf-8"))):
        try:
            build_parser().parse_args(call)
        except SystemExit as end:
            assert end.code == 0, f"{page_name(page)}: ast-sim {shlex.join(call)}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name != "reference"], ids=page_name)
def test_pages_import_from_the_packages_not_from_what_is_in_them(page):
    code = program([block for block in blocks(page.read_text(encoding="utf-8")) if block.kind == "python"])
    assert re.findall(r"^ *(?:from|import) (ast_sim\.\w+\.\S+)", code, re.M) == []


def test_blocks_are_found():
    page = (
        "# A\n\n```python\nx = 1\n```\n\n<!-- test: slow -->\n```python\nx = 2\n```\n\n"
        "1. so\n\n   ```python\n   y = x\n   ```\n"
        "```sh\n$ ast-sim info a.h5 | less  # look\nast-sim evaluate run \\\n  a.h5 > found\npip install it\n"
        "torchrun -m ast_sim.cli train a.h5 --out r\n```\n"
    )
    found = blocks(page)
    assert [(block.kind, block.mark, block.line) for block in found] == [
        ("python", "", 3),
        ("python", "slow", 8),
        ("python", "", 14),
        ("sh", "", 17),
    ]
    assert program(found).splitlines() == [*[""] * 3, "x = 1", *[""] * 10, "y = x"]
    assert calls_of(found) == [["info", "a.h5"], ["evaluate", "run", "a.h5"], ["train", "a.h5", "--out", "r"]]
