"""The pages of the reference are what the sources say."""

import builtins
import re
from pathlib import Path

import pytest

import ast_sim
from ast_sim import AstSimError
from ast_sim.support import errors

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def reference(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    import make_reference

    return make_reference


@pytest.mark.parametrize("page", ["api.md", "commands.md"])
def test_pages_are_as_the_sources_say(page, reference):
    committed = (reference.FOLDER / page).read_text(encoding="utf-8")
    # Versions of Python break the lines of a usage at other places.
    assert committed.split() == reference.PAGES[page]().split(), f"{page} is not up to date: run `make docs`"


def test_every_command_and_every_public_name_has_a_place(reference):
    commands, api = reference.commands(), reference.api()
    for name in ("demo", "generate", "convert", "info", "train", "evaluate", "report"):
        assert f"## `ast-sim {name}`" in commands
    assert "train.peak_rate=" in commands and "(AST_SIM" not in commands
    assert "## `ast_sim.Dataset`" in api and "### `Scene.surface()`" in api and "NodeType.HANDLE = 3" in api


def test_every_error_that_is_named_can_be_caught(reference):
    api = reference.api()
    named = {name for entry in re.findall(r"^- `([A-Z][\w, ]*)`:", api, re.MULTILINE) for name in entry.split(", ")}
    assert {"RolloutError", "MissingExtra"} < named
    kinds = {name for name, one in vars(errors).items() if isinstance(one, type) and issubclass(one, AstSimError)}
    for name in (named | kinds) - set(dir(builtins)):
        assert f"## `ast_sim.{name}`" in api and getattr(ast_sim, name) is getattr(errors, name)


def test_what_public_methods_return_has_a_section(reference):
    results = ["AnsweredFrame", "BodyForce", "Figures", "Generated", "NamedField", "PermanentSet", "PhysicsCheck"]
    api = reference.api()
    assert all(f"## `ast_sim.{name}`" in api for name in [*results, "SceneMesh", "Sweep"])
    assert "BodyForce(frame: int, time: float | None, body: int, force: np.ndarray, torque: np.ndarray)" in api


def press(
    force: float, *, at: "tuple[float, float, float]" = (0.0, 0.0, 0.0), name: str = "punch", told=lambda line: None
) -> "int | None":
    """Press a body.

    Args:
        force: in newton,
            above 0.
        at, name: where, and who.

    Returns:
        The body.

    Raises:
        ValueError: no force: it must be above 0.
    """


def test_a_signature_and_a_docstring_become_markdown(reference):
    shown, text = reference.described("press", press)
    assert shown.splitlines() == [
        "```py",
        "press(",
        "    force: float,",
        "    *,",
        "    at: tuple[float, float, float] = (0.0, 0.0, 0.0),",
        "    name: str = 'punch',",
        "    told=...,",
        ") -> int | None",
        "```",
    ]
    assert text.splitlines() == [
        "Press a body.",
        "",
        "**Args**",
        "",
        "- `force`: in newton,",
        "  above 0.",
        "- `at, name`: where, and who.",
        "",
        "**Returns**",
        "",
        "The body.",
        "",
        "**Raises**",
        "",
        "- `ValueError`: no force: it must be above 0.",
    ]
