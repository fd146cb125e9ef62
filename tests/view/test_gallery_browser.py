"""The report of a dataset in a real browser: panels move, bars add up, a scene opens large, nothing fails."""

from __future__ import annotations

import base64
import dataclasses
import io

import numpy as np
import pytest
from on_screen import HOSTILE, differ, drawn, show, texts
from PIL import Image
from view_scenes import cloth, pair

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import Trajectory
from ast_sim.view.dataset_page import gallery

BLOCKS = DatasetInfo(
    "abcd", "quasi_static", "element", (0.0, 0.0, 0.0), 1.0, 0.003, 0.0, generator={"command": HOSTILE}
)
FRAMES = 11
TILES = [f".tile-scene:nth-child({number}) canvas" for number in (1, 2, 3)]


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    """Three pairs of blocks, pressed ever deeper: the second stopped early, the third has an inverted element."""
    folder = tmp_path_factory.mktemp("gallery")
    changes = [{}, {"status": "truncated", "stopped_by": HOSTILE}, {"min_jacobian": -0.25}]
    with DatasetWriter(folder / "blocks.h5", BLOCKS) as writer:
        for i, (split, change) in enumerate(zip(("train", "train", "test"), changes, strict=True)):
            sample = pair(FRAMES, cells=3, crush=(0.05, 0.1, 0.16)[i])
            attributes = {**sample.attributes, **change}
            if i == 1:
                sample = Trajectory(sample.scene, sample.position[:7], sample.stress[:7])
            writer.add(split, dataclasses.replace(sample, attributes=attributes))
    gallery.write(folder / "report.html", folder / "blocks.h5")
    show(browser, folder / "report.html", still=False)
    return folder / "report.html"


def test_one_sample_is_no_plural(browser, page, tmp_path):
    with DatasetWriter(tmp_path / "one.h5", BLOCKS) as writer:
        writer.add("train", pair(FRAMES, cells=3, crush=0.05))
    gallery.write(tmp_path / "one.html", tmp_path / "one.h5")
    show(browser, tmp_path / "one.html", still=False)
    text = browser.evaluate("document.querySelector('header').textContent + document.querySelector('main').textContent")
    for words in ("1 of 1 sample", "largest displacement: 1 sample.", "The figures of 1 sample"):
        assert words in text
    assert "1 samples" not in text and browser.errors == []
    show(browser, page, still=False)


def at(browser, seconds, tiles=TILES):
    """What the canvases of the tiles hold, [height, width, 4], so long after the first frame."""
    browser.evaluate(
        "(async g => { const tiles = document.querySelector('#gallery-tiles');"
        " tiles.scrollIntoView({ block: 'center', behavior: 'instant' });"
        " await new Promise(done => requestAnimationFrame(() => setTimeout(done, 20)));"
        f" g.pause(); g.seconds = {seconds}; g.draw(); }})(report.gallery)"
    )
    return [canvas(browser, tile) for tile in tiles]


def canvas(browser, selector):
    data = browser.evaluate(f"document.querySelector({selector!r}).toDataURL().split(',')[1]")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA"))


def test_every_scene_has_a_coloured_panel(browser, page):
    assert texts(browser, ".tile-scene b") == ["train/000000", "train/000001", "test/000000"]
    assert texts(browser, ".tile-scene .figures") == ["50.0 mm · 100 kPa", "60.0 mm · 120 kPa", "160 mm · 320 kPa"]
    assert texts(browser, ".tile-scene .ended") == ["stopped after frame 6"]
    # Motion is unwanted here: each panel shows its largest displacement.
    assert browser.evaluate("report.gallery.playing") is False
    assert browser.evaluate("report.gallery.tiles.map(tile => tile.shown[0])") == [10, 6, 10]
    for tile in TILES:
        picture = browser.picture(tile)
        assert 0.1 < drawn(picture) < 0.8
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
    assert texts(browser, "#gallery-scale-label") == ["Displacement magnitude (mm)"]
    assert texts(browser, "#gallery-scale-bar b") == ["0", "40.0", "80.0", "120", "160"]


def test_panels_move_together_and_a_stopped_one_waits(browser, page):
    first, middle, end = at(browser, 0.0), at(browser, 2.2), at(browser, 4.4)
    assert browser.evaluate("report.gallery.tiles.map(tile => tile.shown)") == [[10, 10, 0], [6, 6, 0], [10, 10, 0]]
    for before, after in zip(first, middle, strict=True):
        assert differ(before, after) > 0.03
    assert differ(middle[0], end[0]) > 0.02 and differ(middle[2], end[2]) > 0.05
    at(browser, 2.42)  # between frames 5 and 6
    assert browser.evaluate("report.gallery.tiles[0].shown") == pytest.approx([5, 6, 0.5], abs=1e-6)
    stopped = at(browser, 3.0)[1]
    assert differ(stopped, at(browser, 4.0)[1]) == 0


def test_stress_has_its_own_colours(browser, page):
    before = at(browser, 4.4)
    browser.click("#gallery-color label:nth-of-type(2) input")
    assert texts(browser, "#gallery-scale-label") == ["von Mises stress (kPa)"]
    assert differ(before[2], canvas(browser, TILES[2])) > 0.1
    browser.click("#gallery-color label:nth-of-type(1) input")
    assert differ(before[2], canvas(browser, TILES[2])) == 0


def test_it_plays_and_pauses(browser, page):
    at(browser, 0.0)
    browser.click("#gallery-play")
    assert texts(browser, "#gallery-play") == ["Pause"]
    browser.wait("report.gallery.seconds > 0.5")
    browser.click("#gallery-play")
    assert texts(browser, "#gallery-play") == ["Play"]
    seconds = browser.evaluate("report.gallery.seconds")
    browser.evaluate("new Promise(done => setTimeout(done, 100))")
    assert browser.evaluate("report.gallery.seconds") == seconds


def test_a_scene_opens_large_and_escape_closes_it(browser, page):
    browser.evaluate("document.querySelector('.tile-scene:nth-child(2)').focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="Enter", windowsVirtualKeyCode=13, text="\r")
    browser.call("Input.dispatchKeyEvent", type="keyUp", key="Enter", windowsVirtualKeyCode=13)
    browser.wait("document.querySelector('#enlarged').open && report.viewer !== null")
    browser.evaluate("(async () => { while (report.viewer.drawing) await report.viewer.drawing; })()")
    assert texts(browser, "#scene-choice input:checked + span") == ["train/000001"]
    assert texts(browser, ".panel figcaption") == ["Simulation392 nodes, stopped after frame 6"]
    assert texts(browser, "#frame-label") == ["frame 0 of 6"]
    assert 0.05 < drawn(browser.picture(".panel .stage")) < 0.6
    browser.press("ArrowRight")
    assert texts(browser, "#frame-label") == ["frame 1 of 6"]
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="Escape", windowsVirtualKeyCode=27)
    browser.wait("!document.querySelector('#enlarged').open")
    assert browser.evaluate("document.activeElement.className") == "tile-scene"
    # Its keys do nothing while it is closed.
    browser.evaluate("document.activeElement.blur()")
    browser.press("ArrowRight")
    assert browser.evaluate("report.viewer.state.frame") == 1


def test_bars_add_up_and_axes_have_units(browser, page):
    charts = "[...document.querySelectorAll('#histograms-charts .plot')]"
    titles = browser.evaluate(f"{charts}.map(plot => [plot.layout.xaxis.title.text, plot.layout.yaxis.title.text])")
    assert titles == [
        ["Largest displacement (mm)", "Samples"],
        ["Largest von Mises stress (kPa)", "Samples"],
        ["Largest contact area (cm²)", "Samples"],
        ["Newton iterations", "Frames"],
        ["Nodes", "Samples"],
        ["Elements", "Samples"],
    ]
    width = "part => part.getBoundingClientRect().width"
    fits = f"plot => ({width})(plot.querySelector('.main-svg')) <= ({width})(plot) + 1"
    assert browser.evaluate(f"{charts}.every({fits})")  # none is drawn over its neighbour
    total = "trace => trace.y.reduce((sum, count) => sum + count, 0)"
    sums = browser.evaluate(f"{charts}.map(plot => plot.data.map({total}))")
    assert sums == [[2, 1], [2, 1], [2, 1], [20, 10], [2, 1], [2, 1]]
    assert browser.evaluate(f"{charts}[0].data.map(trace => trace.name)") == ["train", "test"]
    assert browser.evaluate(f"{charts}[0].querySelectorAll('.bars .point path').length") >= 3
    assert drawn(browser.picture("#histograms-charts .plot")) > 0.05
    assert texts(browser, ".chart .absent") == ["Not recorded in this file."] * 2
    assert texts(browser, ".chart .figures")[0] == "Median 60.0 mm · 90 % in 51.0 to 150 · largest 160"


def test_tables_tell_yield_bounds_and_facts(browser, page):
    assert texts(browser, ".tile .value")[:2] == ["66.6 %", "4 of 5"]
    assert texts(browser, "#yield-tables table:first-of-type td")[:6] == ["1", "1", "50.0 %", "1", "0", "100 %"]
    assert HOSTILE in texts(browser, "#yield-tables td")
    rows = [texts(browser, f"#bounds-tables tbody tr:nth-child({row}) td") for row in (1, 2, 4)]
    assert rows[0] == ["✓ pass", "> 0", "400 µm", "train/000000", "3"]
    assert rows[1] == ["✗ fail: 1", "> 0", "−0.250 to 0.600", "test/000000", "3"]
    assert rows[2] == ["✓ pass", "≤ 0.005", "0", "train/000000", "2"]
    assert texts(browser, "#samples-tables tbody th")[2] == "test/000000 shown above"
    assert HOSTILE in texts(browser, "#facts td")
    sections = "[...document.querySelectorAll('main section')].map(section => section.id)"
    assert browser.evaluate(sections) == ["gallery", "histograms", "yield", "bounds", "samples", "facts"]


def test_dark_mode_and_phone(browser, page):
    at(browser, 4.4)
    light = browser.picture(TILES[0])
    browser.prefer(color_scheme="dark", reduced_motion="reduce")
    dark = browser.picture(TILES[0])
    assert light[2, 2].mean() > 200 and dark[2, 2].mean() < 60
    assert 0.1 < drawn(dark) < 0.8
    browser.prefer(color_scheme="light", reduced_motion="reduce")
    browser.call("Emulation.setDeviceMetricsOverride", width=390, height=800, deviceScaleFactor=1, mobile=False)
    browser.wait("document.documentElement.scrollWidth === 390")  # charts follow in time
    assert 0.1 < drawn(at(browser, 4.4)[2]) < 0.8
    browser.call("Emulation.setDeviceMetricsOverride", width=1000, height=700, deviceScaleFactor=1, mobile=False)


def test_nothing_is_loaded_and_nothing_fails(browser, page):
    assert browser.errors == []
    assert {url for url in browser.requests if not url.startswith(("data:", "blob:"))} == {page.resolve().as_uri()}
    assert browser.evaluate("document.querySelectorAll('img').length") == 0
    assert browser.evaluate("typeof window.pwned") == "undefined"


def test_cloth_plays_by_itself_without_stress(browser, tmp_path):
    """No stress to choose, an obstacle, and bare records; motion is wanted."""
    info = dataclasses.replace(BLOCKS, family="sphere_simple", integration="dynamic", stress_location="none")
    with DatasetWriter(tmp_path / "cloth.h5", info) as writer:
        writer.add("train", Trajectory(cloth(5).scene, cloth(5).position))
    gallery.write(tmp_path / "report.html", tmp_path / "cloth.h5")
    browser.prefer(color_scheme="light", reduced_motion="no-preference")
    show(browser, tmp_path / "report.html", still=False)
    browser.wait("report.gallery.playing && report.gallery.seconds > 0.3")
    (start,), (end,) = at(browser, 0.0, TILES[:1]), at(browser, 4.4, TILES[:1])
    assert differ(start, end) > 0.05
    assert browser.evaluate("document.querySelector('#gallery-color').hidden") is True
    assert browser.evaluate("document.querySelector('#gallery-obstacle').hidden") is False
    assert len(texts(browser, ".chart .absent")) == 5
    browser.prefer(color_scheme="light", reduced_motion="reduce")
    assert browser.errors == []
