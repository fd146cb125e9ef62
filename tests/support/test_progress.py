"""One idea of progress: a bar, lines, nothing, or a call; lines that are no progress are logged."""

import logging

import pytest

from ast_sim.support import progress
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Patience, Progress


@pytest.fixture
def now(monkeypatch):
    """A clock that a test moves."""
    clock = [0.0]
    monkeypatch.setattr("ast_sim.support.progress.time.monotonic", lambda: clock[0])
    return clock


def test_a_function_is_told_of_each_unit_and_nothing_is_written(capsys):
    told = []
    with Progress(5, "scenes", lambda *values: told.append(values), done=1) as bar:
        bar.advance("test/000001")
        bar.advance("two more", 2)
        bar.line("a line")
    assert told == [(2, 5, "test/000001"), (4, 5, "two more")]
    assert capsys.readouterr() == ("", "")


def test_lines_come_seldom_and_short_work_has_none(now, capsys):
    with Progress(4, "scenes", True) as bar:
        bar.advance()
        now[0] = 12.0
        bar.advance()
        now[0] = 15.0
        bar.advance()
        assert capsys.readouterr().err == "2 of 4 scenes, 6 s each, 12 s to go\n"
        bar.advance()
        assert capsys.readouterr().err == "4 of 4 scenes, 4 s each, 0 s to go\n"
    with Progress(2, "scenes", True) as bar:
        bar.advance("", 2)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("shown", [True, False])
def test_lines_are_logged_and_shown_where_progress_is(shown, caplog, capsys):
    caplog.set_level(logging.INFO, "ast_sim")
    with Progress(1, "scenes", shown) as bar:
        bar.line("what it does")
        bar.line("what is wrong", logging.WARNING)
    assert [(record.levelname, record.message) for record in caplog.records] == [
        ("INFO", "what it does"),
        ("WARNING", "what is wrong"),
    ]
    assert capsys.readouterr().err == ("what it does\nwhat is wrong\n" if shown else "")


def test_a_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SECONDS_BEFORE_BAR", 0.0)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Progress(2, "scenes", True) as bar:
        bar.advance("", 2)
    assert "100%" in capsys.readouterr().err


def test_what_is_no_progress_is_refused():
    with pytest.raises(ConfigError, match="progress is 'yes'; it must be True, False or a function of"):
        Progress(1, "scenes", "yes")


def test_only_what_takes_long_is_told(monkeypatch, capsys):
    patience = Patience(Progress(1, "frames", True))
    patience.tell("soon")
    monkeypatch.setattr(Patience, "QUIET", 0.0)
    patience.tell("late")
    monkeypatch.setattr(Patience, "QUIET", 100.0)
    patience.tell("again soon")
    assert capsys.readouterr().err == "late\n"


@pytest.mark.parametrize("progress", [False, lambda done, total, text: None])
def test_what_takes_long_goes_to_the_log_alone_where_no_progress_is_shown(progress, monkeypatch, capsys, caplog):
    caplog.set_level(logging.INFO, "ast_sim")
    monkeypatch.setattr(Patience, "QUIET", 0.0)
    Patience(Progress(1, "frames", progress)).tell("late")
    assert capsys.readouterr() == ("", "") and [record.message for record in caplog.records] == ["late"]
