"""The report in a real browser: no error on the console, nothing asked of the network, and everything is drawn."""

from __future__ import annotations

import numpy as np
import pytest
from browser import Browser
from chosen_figures import evaluation, metrics
from on_screen import HOSTILE, differ, drawn, settle, show, texts
from view_scenes import plate, strip

from ast_sim.scene import Trajectory
from ast_sim.view.report import ReportRun, ReportScene, representative, write

LEFT, RIGHT = ".panel:nth-child(1) .stage", ".panel:nth-child(2) .stage"


@pytest.fixture(scope="module")
def browser():
    with Browser(900, 640) as browser:
        browser.prefer(color_scheme="light", reduced_motion="reduce")
        yield browser


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    """The report of one run on three plates, with a hostile title and hostile names."""
    errors = {HOSTILE: 1e-3, "test/000001": 2e-3, "test/000002": 3e-3, "test/000003": None}
    chosen = representative({name: np.inf if e is None else e for name, e in errors.items()})
    scenes = [
        ReportScene(name, label, plate(9, depth=0.03 + 0.01 * i), plate(9, depth=0.03 + 0.01 * i, seed=i))
        for i, (label, name) in enumerate(chosen)
    ]
    path = tmp_path_factory.mktemp("report") / "report.html"
    write(path, [ReportRun(HOSTILE, "ast", scenes, evaluation(errors), metrics(), {"Model": HOSTILE})], HOSTILE)
    show(browser, path)
    assert texts(browser, "#scene-choice input:checked + span") == ["Median 2.00 mm"]
    assert browser.evaluate("report.viewer.state.playing") is False  # motion is unwanted here
    choose(browser, "scene", 0)
    return path


def choose(browser, group, index):
    browser.click(f"#{group}-choice label:nth-of-type({index + 1}) input")
    settle(browser)


def to_frame(browser, frame):
    browser.evaluate(
        f"(() => {{ const s = document.querySelector('#frame'); s.value = {frame};"
        " s.dispatchEvent(new Event('input', { bubbles: true })); })()"
    )
    settle(browser)


def cameras(browser):
    return np.array(
        browser.evaluate(
            "report.viewer.panels.map(panel => { const { eye } = panel.camera(); return [eye.x, eye.y, eye.z]; })"
        )
    )


def test_both_panels_are_drawn_in_colours(browser, page):
    to_frame(browser, 4)
    for panel in (LEFT, RIGHT):
        picture = browser.picture(panel)
        assert 0.08 < drawn(picture) < 0.8
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
    assert browser.evaluate("document.querySelector('#frame-label').textContent") == "frame 4 of 8"
    assert differ(browser.picture(LEFT), browser.picture(RIGHT)) > 0.002


def test_the_slider_moves_both_meshes(browser, page):
    to_frame(browser, 0)
    before = [browser.picture(panel) for panel in (LEFT, RIGHT)]
    to_frame(browser, 4)
    for old, panel in zip(before, (LEFT, RIGHT), strict=True):
        assert differ(old, browser.picture(panel)) > 0.03


def test_the_stress_switch_changes_colours_and_scale(browser, page):
    to_frame(browser, 4)
    before = browser.picture(LEFT)
    assert browser.evaluate("document.querySelector('#scale-label').textContent") == "Displacement magnitude (mm)"
    assert browser.evaluate("document.querySelector('#scale-bar').lastChild.textContent") == "30.0"
    choose(browser, "color", 1)
    assert differ(before, browser.picture(LEFT)) > 0.05
    assert browser.evaluate("document.querySelector('#scale-label').textContent") == "von Mises stress (kPa)"
    choose(browser, "color", 0)
    assert differ(before, browser.picture(LEFT)) < 0.002


def test_the_other_scenes_are_other_pictures(browser, page):
    to_frame(browser, 4)
    first = browser.picture(LEFT)
    choose(browser, "scene", 2)
    assert differ(first, browser.picture(LEFT)) > 0.01
    assert texts(browser, "#scene-choice span") == ["Best 1.00 mm", "Median 2.00 mm", "Worst"]
    choose(browser, "scene", 0)


def test_the_mouse_turns_both_sides_together(browser, page):
    before, picture = cameras(browser), browser.picture(LEFT)
    browser.drag(RIGHT, by=(60, 15))
    browser.wait("report.viewer.tracked === null && !report.viewer.moving")
    settle(browser)
    after = cameras(browser)
    np.testing.assert_allclose(after[0], after[1], atol=1e-9)
    assert np.abs(after - before).max() > 0.1
    assert differ(picture, browser.picture(LEFT)) > 0.03
    browser.click("#reset-view")
    browser.wait("!report.viewer.moving")
    settle(browser)
    np.testing.assert_allclose(cameras(browser), before, atol=1e-9)


def test_keys_play_step_and_turn(browser, page):
    to_frame(browser, 3)
    browser.evaluate("document.activeElement.blur()")
    browser.press("ArrowRight")
    assert browser.evaluate("report.viewer.state.frame") == 4
    browser.press("Home")
    assert browser.evaluate("report.viewer.state.frame") == 0
    browser.press(" ")
    assert browser.evaluate("document.querySelector('#play').ariaLabel") == "Pause"
    browser.wait("report.viewer.state.frame >= 2")
    browser.press(" ")
    assert browser.evaluate("report.viewer.state.playing") is False
    settle(browser)
    before = cameras(browser)
    browser.evaluate(f"document.querySelector({LEFT!r}).focus()")
    browser.press("ArrowRight")
    browser.wait("!report.viewer.moving")
    after = cameras(browser)
    np.testing.assert_allclose(after[0], after[1], atol=1e-9)
    turned = np.arctan2(after[0, 1], after[0, 0]) - np.arctan2(before[0, 1], before[0, 0])
    assert turned == pytest.approx(0.1, abs=1e-6)
    browser.click("#reset-view")


def test_error_curves_follow_the_frame(browser, page):
    to_frame(browser, 5)
    plots = "document.querySelectorAll('#over-time-charts .plot')"
    assert browser.evaluate(f"{plots}.length") == 3
    assert browser.evaluate(f"{plots}[0].layout.shapes[0].x0") == 5
    assert browser.evaluate(f"{plots}[0].data.map(trace => trace.name)") == ["Hold still", "Prediction"]
    assert browser.evaluate(f"{plots}[0].data[0].y.length") == 9
    assert drawn(browser.picture("#over-time-charts .plot")) > 0.005


def test_tables_have_units_and_sensible_digits(browser, page):
    text = browser.evaluate("document.querySelector('#accuracy').innerText")
    assert "Displacement (mm)" in text and "von Mises stress (kPa)" in text
    found = texts(browser, "#accuracy tbody tr:nth-child(2) td")
    assert found == ["1.43 0.22×", "6.50", "6.50", "6.78 0.60×", "20.7", "15.8", "11.3"]
    assert texts(browser, ".tile .value") == ["1.43 mm", "6.78 kPa", "2.00 ms", "17×", "4"]
    rows = texts(browser, "#all-scenes tbody th")
    assert rows[0] == f"{HOSTILE} shown above: best"
    assert rows[1:] == ["test/000001 shown above: median", "test/000002", "test/000003 shown above: worst"]


def test_training_and_facts_are_shown(browser, page):
    assert browser.evaluate("document.querySelectorAll('#training .plot .scatterlayer .trace').length") == 5
    text = browser.evaluate("document.querySelector('#facts').innerText")
    for part in ("training", "over-time"):
        # A card becomes narrower when one comes beside it: the chart follows.
        wider = browser.evaluate(
            f"[...document.querySelectorAll('#{part} .chart:not([hidden])')].map(card => {{"
            " const drawn = card.querySelector('.plot .main-svg').getBoundingClientRect();"
            " return drawn.width - card.clientWidth; })"
        )
        assert len(wider) == {"training": 2, "over-time": 3}[part] and max(wider) <= 0 and min(wider) > -40, part
    for fact in ("0123456789abcdef", "A processor, 2 threads", "python 3.11.2, torch 2.13.0", "--out <file>"):
        assert fact in text


def test_dark_mode_changes_page_and_charts(browser, page):
    browser.prefer(color_scheme="dark", reduced_motion="reduce")
    settle(browser)
    assert browser.picture("header").mean() < 60
    assert browser.picture("#over-time-charts").mean() < 70
    assert 0.05 < drawn(browser.picture(LEFT)) < 0.8
    browser.prefer(color_scheme="light", reduced_motion="reduce")
    settle(browser)
    assert browser.picture("header").mean() > 200


def test_hostile_names_are_text(browser, page):
    assert browser.evaluate("document.querySelector('h1').textContent") == HOSTILE
    assert browser.evaluate("document.title") == HOSTILE
    assert browser.evaluate("document.querySelectorAll('img').length") == 0
    assert browser.evaluate("typeof window.pwned") == "undefined"


def test_nothing_is_loaded_and_nothing_fails(browser, page):
    assert browser.errors == []
    assert {url for url in browser.requests if not url.startswith(("data:", "blob:"))} == {page.resolve().as_uri()}
    blocked = browser.evaluate(
        "new Promise(done => { document.addEventListener('securitypolicyviolation', e => done(e.blockedURI));"
        " fetch('https://example.org/').catch(() => {}); })"
    )
    assert blocked.startswith("https://example.org")


def test_unusual_scenes(browser, tmp_path):
    """No stress, stress in elements, 2-D, a prediction that ends early, one without stress, a single frame."""
    short = plate(9, seed=1)
    short = Trajectory(short.scene, short.position[:4], short.stress[:4], {"status": "truncated"})
    pairs = {
        "no stress": (plate(9, stress="none"), plate(9, stress="none", seed=1)),
        "elements": (plate(9, stress="element"), plate(9, stress="element", seed=1)),
        "flat": (strip(9), strip(9)),
        "flat, nodes": (strip(9, stress="node"), strip(9, stress="node")),
        "short": (plate(9), short),
        "no predicted stress": (plate(9), plate(9, stress="none", seed=1)),
        "one frame": (plate(1, depth=0.0), plate(1, depth=0.0)),
    }
    scenes = [ReportScene(name, name, *pair) for name, pair in pairs.items()]
    write(tmp_path / "report.html", [ReportRun("run", "ast", scenes)], "Unusual scenes")
    show(browser, tmp_path / "report.html")
    colors = "(c => c.hidden ? 1 : c.querySelectorAll('input').length)(document.querySelector('#color-choice'))"
    for index, (name, (truth, _)) in enumerate(pairs.items()):
        choose(browser, "scene", index)
        assert browser.evaluate(colors) == (1 if truth.stress is None else 2), name
        if truth.stress is not None:
            choose(browser, "color", 1)
        to_frame(browser, min(6, truth.num_frames - 1))
        for panel in (LEFT, RIGHT):
            assert drawn(browser.picture(panel)) > 0.03, name
        note = browser.evaluate("(n => n.hidden ? '' : n.textContent)(document.querySelectorAll('.ended')[1])")
        expected = {"short": "ended after frame 3", "no predicted stress": "the prediction has no stress"}
        assert note == expected.get(name, ""), name
    assert browser.evaluate("[...document.querySelectorAll('#play, #frame')].every(control => control.disabled)")
    shown = "[...document.querySelectorAll('main section')].filter(s => !s.hidden).map(s => s.id)"
    assert browser.evaluate(shown) == ["scenes", "over-time"]
    assert browser.errors == []


def test_several_runs_side_by_side(browser, tmp_path):
    """One panel, one curve and one row a run; a scene that a run lacks leaves its panel out."""
    truth = {"a": plate(5), "b": plate(5, depth=0.05)}
    both = [ReportScene(name, name, t, plate(5, seed=i)) for i, (name, t) in enumerate(truth.items())]
    runs = [
        ReportRun("ast", "ast", both, evaluation({"a": 1e-3, "b": 2e-3}), metrics()),
        ReportRun("ast", "ast", both[:1], evaluation({"a": 3e-3}, scale=2.0), metrics(200)),
    ]
    write(tmp_path / "report.html", runs, "Two runs")
    show(browser, tmp_path / "report.html")
    visible = ".panel:not([hidden]) b"
    assert texts(browser, visible) == ["Truth", "Prediction of ast", "Prediction of ast (2)"]
    to_frame(browser, 2)
    assert drawn(browser.picture(".panel:nth-child(3) .stage")) > 0.05
    first, second = (texts(browser, f"#comparison tbody tr:nth-child({row}) > *") for row in (1, 2))
    assert first == ["ast", "1.43 mm", "6.78 kPa", "2.00 ms", "17.0 ×"]
    assert second == ["ast (2)", "2.86 mm", "13.6 kPa", "2.00 ms", "17.0 ×"]
    choose(browser, "scene", 1)
    assert texts(browser, visible) == ["Truth", "Prediction of ast"]
    choose(browser, "scene", 0)
    assert drawn(browser.picture(".panel:nth-child(3) .stage")) > 0.05
    assert browser.errors == []


def test_only_some_units_take_a_prefix(browser, tmp_path):
    """Millimetres, and stress so small that its prefix would be milli: "mPa" would be read as MPa."""
    errors = {"a": 0.268, "b": 2.0}
    chosen = [ReportScene(name, name, plate(5), plate(5, seed=1)) for name in errors]
    found = evaluation(errors, scale=1e-5, length_unit="mm")
    write(tmp_path / "report.html", [ReportRun("run", "ast", chosen, found, metrics())], "Millimetres")
    show(browser, tmp_path / "report.html")
    assert texts(browser, ".tile .value")[:2] == ["1.43e−8 mm", "0.0678 Pa"]
    assert texts(browser, "#scene-choice span small")[0] == "0.268 mm"
    titles = texts(browser, "#over-time .ytitle, #all-scenes .ytitle, #training .ytitle")
    assert titles and all("(mm)" in title for title in titles if "RMSE" in title), titles
    assert not any(word in browser.evaluate("document.body.innerText") for word in ("mmm", "µmm", "mPa"))


def test_it_plays_by_itself_unless_motion_is_unwanted(browser, tmp_path):
    write(
        tmp_path / "report.html",
        [ReportRun("run", "ast", [ReportScene("a", "Only scene", strip(4), strip(4))])],
        "Strip",
    )
    browser.prefer(color_scheme="light", reduced_motion="no-preference")
    show(browser, tmp_path / "report.html", still=False)
    browser.wait("report.viewer.state.playing && report.viewer.state.frame >= 2")
    browser.click("#play")
    settle(browser)
    browser.prefer(color_scheme="light", reduced_motion="reduce")
    assert browser.errors == []
