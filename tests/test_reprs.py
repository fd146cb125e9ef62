"""What objects show of themselves: a line at a prompt, a table in a notebook, a drawing of a scene."""

import re
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import toy
from meshes import two_tetrahedra

import ast_sim
from ast_sim import Dataset, Scene, scene_summary
from ast_sim.inference.answer import Answer
from ast_sim.mechanics.driven import Driven
from ast_sim.named_field import NamedField
from ast_sim.support.notebook_table import html_bars
from ast_sim.trade_figures import Setting, TradeFigures

TRUTH = toy.plate()


def answer(**changes) -> Answer:
    values = {"given": 1, "step_seconds": [0.1], "info": toy.info(), "stress_location": "node", "frames": (0, 3)}
    values |= {"position": TRUTH.position[[0, 3]], "stress": TRUTH.stress[[0, 3]]}
    return Answer("<b>toy</b>", TRUTH.scene, **{**values, **changes})


def test_lines():
    assert repr(two_tetrahedra(material=np.ones((2, 2), np.float32))) == (
        "Scene(bodies: 2, nodes: 5 (3 normal, 1 obstacle, 1 handle), tetrahedra: 2, extent: 1 x 1 x 1,"
        " material: 2 columns)"
    )
    assert repr(replace(TRUTH, stress_location="node", length_unit="m")) == (
        "Trajectory(frames: 0 to 6, nodes: 48, stress: at each node, lengths: m, status: complete)"
    )
    assert repr(replace(TRUTH, stress=None)) == (
        "Trajectory(frames: 0 to 6, nodes: 48, stress: none, lengths: in a unit that is not known, status: complete)"
    )
    moved = np.linalg.norm(TRUTH.position[3] - TRUTH.scene.rest_position, axis=1)[:-8].max()
    assert repr(answer(expected_error=0.025, last_steps=(0.01,), seconds=0.5)) == (
        f"Answer(name: <b>toy</b>, frames: 0, 3, nodes: 48, largest displacement: {moved:.4g} m,"
        f" largest stress: {TRUTH.stress[3].max():.4g} Pa, expected error: 2.5 %, converged: yes, seconds: 0.5)"
    )
    coloured = replace(answer(), name="\x1b[31m<i>\udc80\n")
    assert repr(coloured).startswith("Answer(name: \\x1b[31m<i>\\udc80\\n, frames")
    assert "\\x1b[31m&lt;i&gt;\\udc80\\n</td>" in coloured._repr_html_()
    failed = answer(failure="too far", info=None)
    assert "expected error: not known, converged: no Newton steps" in repr(failed)
    assert repr(failed).endswith("failure: too far)")


def test_a_dataset_and_a_split(tmp_path):
    with Dataset(toy.write(tmp_path / "a<b.h5", (3, 0, 2))) as data:
        assert repr(data) == (
            "Dataset(file: a<b.h5, scenes: 3 train, 2 test, family: toy_plate, stress: at each node, lengths: m)"
        )
        assert repr(data["train"][1:]) == "Split(name: train, scenes: 2, file: a<b.h5)"
        for shown in (data._repr_html_(), data["test"]._repr_html_()):
            assert "a&lt;b.h5" in shown and "a<b.h5" not in shown
            assert [cell.text for cell in ElementTree.fromstring(shown).iter("th")][0] in ("file", "name")
    assert repr(data).startswith("Dataset(")  # a closed one, too


def test_an_evaluation_in_which_a_scene_failed(tmp_path, monkeypatch):
    small = {"model": "mgn", "model_settings": {"hidden": 16, "blocks": 1}, "steps": 1}
    run = ast_sim.train(toy.write(tmp_path / "a.h5", (2, 0, 2)), tmp_path / "run", **small, progress=False)
    whole = run.evaluate(solver_scenes=0, progress=False)
    error = whole.figures.error("displacement").rmse_sequence
    assert f"scenes: 2, displacement error: {error:.4g} m, stress error: " in repr(whole)
    advance = run.model.advance
    broken = ["test/000001"]

    def some_fail(batch, prescribed):
        position, prediction = advance(batch, prescribed)
        fails = any(name.startswith(one) for name in batch.names for one in broken)
        return (torch.full_like(position, torch.nan) if fails else position), prediction

    monkeypatch.setattr(run.model, "advance", some_fail)
    for failed, first in ((1, "test/000001"), (2, "test/000000")):
        with pytest.warns(UserWarning, match=f"{failed} of 2 predictions failed; the first: {first}: the predicted"):
            found = run.evaluate(solver_scenes=0, progress=False)
        assert found.figures.failures == failed
        shown = "Evaluation(run: run, data: a.h5, scenes: 2, displacement error: failed, stress error: failed)"
        assert repr(found) == shown and ">failed</td>" in found._repr_html_()
        assert f"scenes: 2, failed: {failed}" in str(found)
        broken.append("test/000000")


def test_a_scene_is_drawn_from_far_to_near():
    """Of a box the eye sees three sides, an obstacle is see-through, and bodies have colours of their own."""
    box = ast_sim.box((0, 0, 0), (1, 1, 1), (2, 2, 2))
    scene = Scene.join(box, Scene.of(box.rest_position + [0, 0, 2], box.elements, obstacles=[0]))
    root = ElementTree.fromstring(re.search("<svg.*</svg>", scene._repr_html_())[0])
    polygons = list(root)
    assert len(polygons) == 2 * 3 * 8  # two bodies, three sides, eight triangles each
    corners = np.array([[float(x) for x in re.split("[ ,]", polygon.get("points"))] for polygon in polygons])
    width, height = float(root.get("width")), float(root.get("height"))
    assert (
        (corners >= 4.9).all() and (corners[:, ::2] <= width - 4.9).all() and (corners[:, 1::2] <= height - 4.9).all()
    )
    see_through = [polygon.get("fill-opacity") is not None for polygon in polygons]
    assert sum(see_through) == 24
    assert corners[np.array(see_through), 1::2].mean() < corners[~np.array(see_through), 1::2].mean()  # it is above
    assert len({polygon.get("fill") for polygon in polygons}) == 6


def test_a_scene_in_the_plane_is_drawn_as_it_lies():
    scene = Scene.of([[0, 0], [2, 0], [0, 1]], [[0, 1, 2]])
    root = ElementTree.fromstring(re.search("<svg.*</svg>", scene._repr_html_())[0])
    assert root[0].get("points") == "5,180 355,180 5,5"


def test_a_scene_of_very_many_triangles_has_a_table_only(monkeypatch):
    monkeypatch.setattr(scene_summary, "MOST_TRIANGLES", 5)
    shown = two_tetrahedra()._repr_html_()
    assert "<svg" not in shown and "<th" in shown


@pytest.mark.parametrize("extra", [True, False])
def test_an_answer_is_a_table_and_a_picture_if_matplotlib_is_there(monkeypatch, extra):
    if not extra:
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    shown = answer()._repr_html_()
    assert ("data:image/png;base64,iVBOR" in shown) == extra
    assert "&lt;b&gt;toy" in shown and "<b>toy" not in shown
    assert "<th" in answer(position=TRUTH.position[:0], stress=None, frames=(), failure="too far")._repr_html_()


def test_what_holds_arrays_shows_one_line(tmp_path):
    """Numbers of arrays, and addresses of objects, tell nothing."""
    field = NamedField(np.zeros((2, 48, 3), np.float32), "node", "N")
    shown = answer(driven=Driven.of(TRUTH.scene, TRUTH.position), fields={"reaction": field})
    travel = np.linalg.norm(TRUTH.position - TRUTH.position[0], axis=2)[:, TRUTH.scene.body == 1].max()
    assert repr(shown.driven) == f"Driven(body: 1, nodes: 8 of 48, frames: 7, largest travel: {travel:.4g})"
    assert repr(field) == "NamedField(at each: node, values: 2 x 48 x 3, unit: N)"
    moved = np.linalg.norm(TRUTH.position[3] - TRUTH.scene.rest_position, axis=1).max()
    assert repr(shown.frame(3)) == (
        f"AnsweredFrame(number: 3, time: {shown.frame(3).time:.4g} s, nodes: 48, largest displacement: {moved:.4g},"
        f" largest stress: {TRUTH.stress[3].max():.4g} Pa, fields: reaction)"
    )
    rows = [{"travel": 1.0}, {"travel": 2.0, "last_newton_step": 1.0}, {"travel": 3.0, "failure": "too far"}]
    assert repr(ast_sim.Sweep(rows, ("travel",), "mm", 0.5)) == (
        "Sweep(rows: 3, varied: travel, failed: 1, not converged: 1, seconds: 0.5)"
    )
    assert repr(ast_sim.Motion(TRUTH.position)) == "Motion(frames: 7, nodes: 48)"
    assert repr(trade()) == "Trade(scenes: 3, errors of: displacement)"
    with pytest.raises(ast_sim.RolloutError, match="no frame -1; it has: 0, 3; a negative number does not count from"):
        shown.plot(-1)


def trade() -> ast_sim.Trade:
    setting = Setting("one call", (0.1, 0.2, 0.3), (1.0, 1.0, 1.0))
    return ast_sim.Trade({"displacement": TradeFigures(("a", "b", "c"), (setting,), (), "why not")})


def test_a_dataset_and_a_split_show_their_first_scene(tmp_path):
    with Dataset(toy.write(tmp_path / "d.h5", (0, 0, 2))) as data:
        split = data["test"]
        assert data._repr_html_().count("<svg") == split._repr_html_().count("<svg") == 1
        assert split[1].scene._repr_html_() in split[1:]._repr_html_()
        assert "<svg" not in data["train"]._repr_html_()
    assert "<svg" not in data._repr_html_() and "<svg" not in split._repr_html_()


def test_bars_are_as_high_as_their_values():
    bars = ElementTree.fromstring(re.search("<svg.*</svg>", html_bars([1.0, 4.0, 0.0], "<e>"))[0])
    assert [bar.get("height") for bar in bars] == ["25", "100", "0"] and "&lt;e&gt;" in html_bars([1.0], "<e>")
    assert html_bars([], "<e>") == ""
    assert html_bars([9.0] + 100 * [1.0], "").count('height="100" fill') == 100
