"""Links lead somewhere: in every Markdown page and notebook, and from the code to its pages."""

import json
import re
from collections import Counter
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("ast_sim", "benchmarks", "csrc", "docs", "examples", "tests")
LINK = re.compile(r"\]\(([^()\s]+)\)")
FENCE = re.compile(r"^(```|~~~).*?^\1\s*$", re.M | re.S)
CODE = re.compile(r"`[^`\n]*`")
NAMED = re.compile(r"(?<![\w/.])(?:docs|csrc)/(?:[\w-]+/)*[\w-]+\.md\b")


def files(*suffixes: str) -> list[Path]:
    inside = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*"))
    return sorted(path for path in (*ROOT.iterdir(), *inside) if path.suffix in suffixes)


def prose(text: str) -> str:
    """A page without its code, in which brackets mean something else."""
    return CODE.sub("", FENCE.sub("", text))


def anchors_in(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them: a second heading of one name ends in -1."""
    found: set[str] = set()
    seen: Counter[str] = Counter()
    for heading in re.findall(r"^#{1,6} +(.+?)\s*$", FENCE.sub("", page.read_text(encoding="utf-8")), re.M):
        shown = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


def broken(page: Path, text: str) -> list[str]:
    """The relative links of a page that lead to no file, or to no heading of it."""
    wrong = []
    for link in LINK.findall(prose(text)):
        if re.match(r"[a-z]+:", link):
            continue
        place, _, anchor = unquote(link).partition("#")
        target = (page.parent / place) if place else page
        if not target.exists() or (anchor and anchor not in anchors_in(target)):
            wrong.append(link)
    return wrong


@pytest.mark.parametrize("page", files(".md"), ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page):
    assert broken(page, page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("notebook", files(".ipynb"), ids=lambda notebook: notebook.name)
def test_every_link_of_a_notebook_leads_somewhere(notebook):
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    assert broken(notebook, "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")) == []


def test_the_pages_that_the_code_names_exist():
    sources = files(".py", ".c", ".h", ".toml", ".js", ".html")
    named = {(name, path) for path in sources for name in NAMED.findall(path.read_text(encoding="utf-8"))}
    assert ("docs/log.md", ROOT / "ast_sim/training/defaults_from_data.py") in named
    assert [f"{path.relative_to(ROOT)}: {name}" for name, path in sorted(named) if not (ROOT / name).exists()] == []


def test_a_broken_link_is_found(tmp_path):
    (tmp_path / "there.md").write_text("# One `x`, two\n\n## Same\n\n## Same\n\n```\n# no heading\n```\n")
    page = tmp_path / "page.md"
    page.write_text("# Here\n")
    right = "[a](there.md) [b](there.md#one-x-two) [c](there.md#same-1) [d](https://x.org/no) `[e](no)` [f](#here)"
    assert broken(page, f"{right}\n\n```\nx[0](no)\n```\n") == []
    wrong = ["no.md", "there.md#two", "there.md#no-heading", "there.md#same-2", "#nowhere"]
    assert broken(page, " ".join(f"![a]({link})" for link in wrong)) == wrong
