"""The page of a trade in a real browser, at three widths."""

from __future__ import annotations

import math

import pytest
from on_screen import HOSTILE, show, texts

from ast_sim.trade_figures import Setting, Side, TradeFigures
from ast_sim.view import trade_page


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    run = (
        Setting("call", (0.05, 0.08), (0.02, 0.02), f"ast-sim predict '{HOSTILE}'"),
        Setting("Newton", (0.01, 0.009), (0.04, 0.04)),
        Setting("no use", (0.05, 0.2), (0.06, 0.06)),
    )
    solver = (Setting("own", (0.0, 0.0), (0.1, 0.1)), Setting("coarse", (0.04, 0.03), (0.05, 0.05)))
    other = Side(HOSTILE, (Setting("one call", (0.02, 0.02), (0.03, 0.03)),))
    failed = Side(HOSTILE, (Setting("one call", (math.inf, math.inf), (0.03, 0.03)),))
    more = {"mesh_errors": (0.02, 0.03, 0.07), "invested": 600.0, "origin": {"run": HOSTILE}}
    figures = TradeFigures(("test/000000", "test/000001"), run, solver, others=(other,), **more)
    path = tmp_path_factory.mktemp("trade") / "trade.html"
    bare = Setting("call", (0.3, 0.4), (0.02, 0.02))
    force = TradeFigures(
        figures.scenes, (bare, *run[1:]), solver, quantity="reaction", others=(failed,), no_process=HOSTILE
    )
    trade_page.write(path, [figures, force], HOSTILE)
    return path


def test_the_table_and_the_chart_show_the_settings(browser, path):
    show(browser, path, still=False)
    assert browser.errors == [] and browser.requests == [path.as_uri()]
    first = ["10 %", "20 mscall", "50 mscoarse", "30 msone call", "2.50 (2.50 to 2.50)", "the run", "20,000 questions"]
    assert texts(browser, "#trade-tables .table-card:first-child tbody tr:first-child > *") == first
    assert texts(browser, "#trade-tables .table-card:first-child tbody tr:last-child > *")[1:6] == [
        "none",
        "100 msown",
        "none",
        "–",
        "the solver alone",
    ]
    lead = (
        "2 scenes that the run has not learned from. Displacement: the run is faster at 10 % and 5 % and 2.5 % and 1 %"
    )
    assert texts(browser, "#lead")[0].startswith(lead)
    drawn = browser.evaluate("document.querySelector('#trade-chart .plot').data.map(({ x, y }) => [x, y])")
    assert drawn[0] == [[60], [20]] and drawn[1] == [[20, 40], [8, 1]]
    assert drawn[3][0] == [50, 100] and drawn[3][1][0] == 4
    assert drawn[5] == [[30], [2]]
    assert drawn[6] == [[20, 100], [3, 3]]  # the mesh itself, over all times
    assert texts(browser, "#trade-chart .legend li") == ["The run", "The solver", HOSTILE, "The mesh itself"]
    head = texts(browser, "#trade-tables .table-card:first-child thead th")
    assert head[2:5] == ["The solver", HOSTILE, "Solver / run"]
    assert texts(browser, "#trade-tables h3") == ["Displacement", "Reaction"]
    few, ahead, mesh, few_again, process = texts(browser, "#trade-tables p")
    assert few == few_again and few.startswith("2 scenes are too few: no interval of 95 % comes from fewer than 6")
    assert ahead == f"{HOSTILE} is ahead of the run at 5 % and 2.5 %."
    assert process == f"No Gaussian process: {HOSTILE}."
    assert mesh.startswith("The mesh alone makes the displacement 3 % wrong (median of 3 scenes, against 8 times")
    call = ["the run", "call", "8 %", "40 %", "20 ms", f"ast-sim predict '{HOSTILE}'"]
    assert texts(browser, "#trade-settings tbody tr:first-child td, #trade-settings tbody tr:first-child th") == call
    last = [HOSTILE, "one call", "2 %", "–", "30 ms", "–"]
    assert texts(browser, "#trade-settings tbody tr:last-child td, #trade-settings tbody tr:last-child th") == last
    assert len(texts(browser, "#trade-settings tbody tr")) == 6
    assert texts(browser, "#facts-tables td") == [HOSTILE]
    assert not texts(browser, "#gallery, #scenes, #training")  # what belongs to other pages is gone


@pytest.mark.parametrize("width", [390, 820, 1600])
def test_nothing_is_wider_than_the_page(browser, path, width):
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=False)
    show(browser, path, still=False)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    plot = "document.querySelector('#trade-chart .plot')"
    assert (
        browser.evaluate(f"{plot}.querySelector('.main-svg').clientWidth")
        <= browser.evaluate(f"{plot}.clientWidth") + 1
    )
