"""How long computations tell where they are."""

from ast_sim.support.progress import Patience


def test_only_what_takes_long_is_told(monkeypatch, capsys):
    patience = Patience()
    patience.tell("soon")
    monkeypatch.setattr(Patience, "QUIET", 0.0)
    patience.tell("late")
    monkeypatch.setattr(Patience, "QUIET", 100.0)
    patience.tell("again soon")
    assert capsys.readouterr().err == "late\n"
