"""What the report's page holds, without a browser; `test_browser.py` opens it."""

from __future__ import annotations

import base64
import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from chosen_figures import NO_DEEPEST, evaluation, metrics
from meshes import two_tetrahedra
from view_scenes import plate, strip

from ast_sim.figures import Beside
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.errors import AstSimError, MissingExtra
from ast_sim.view import encode, page, report, tables
from ast_sim.view.fields import surface_owners


def unpack(packed):
    values = np.frombuffer(base64.b64decode(packed["data"]), "<i2")
    return values * packed["scale"]


def one_run(name="run", model="ast", **scenes):
    chosen = [report.ReportScene(scene, "Only scene", *pair) for scene, pair in scenes.items()]
    return report.ReportRun(name, model, chosen, evaluation({"plate": 1e-3}), metrics(), {"Parameters": "451 203"})


def test_encoded_motion_is_the_surface_to_one_in_65534():
    truth, prediction = plate(5), plate(5, seed=1)
    encoded = encode.encode_scene(truth, np.arange(5), [prediction])
    for name in ("body", "obstacle"):
        triangles, nodes, _ = encode.Boundary(truth.scene).groups[name]
        group = encoded["groups"][name]
        stored = np.frombuffer(base64.b64decode(group["triangles"]), "<u4").reshape(-1, 3)
        rest = np.frombuffer(base64.b64decode(group["rest"]), "<f4").reshape(-1, 3)
        np.testing.assert_array_equal(stored, triangles)
        np.testing.assert_array_equal(rest, truth.scene.rest_position[nodes])
        for trajectory, motion in ((truth, encoded["truth"]), (prediction, encoded["predictions"][0])):
            moved = (trajectory.position - truth.scene.rest_position)[:, nodes]
            found = unpack(motion[name]).reshape(moved.shape)
            np.testing.assert_allclose(found, moved, rtol=0, atol=np.abs(moved).max() / 65000)
    nodes = encode.Boundary(truth.scene).groups["body"][1]
    assert (truth.scene.node_type[nodes] != NodeType.OBSTACLE).all()
    np.testing.assert_allclose(
        unpack(encoded["truth"]["stress"]), truth.stress[:, nodes].ravel(), atol=truth.stress.max() / 65000
    )


def test_every_triangle_knows_its_element():
    scene = plate(1).scene
    surface = scene.surface()
    owners = surface_owners(scene, surface)
    assert all(set(face) <= set(element) for face, element in zip(surface, scene.elements[owners], strict=True))
    np.testing.assert_array_equal(surface_owners(strip().scene, strip().scene.surface()), np.arange(82))


def test_element_stress_stands_on_the_faces():
    truth = plate(3, stress="element")
    surface = encode.Boundary(truth.scene)
    owners = surface.groups["body"][2]
    found = unpack(encode.encode_scene(truth, np.arange(3))["truth"]["stress"]).reshape(3, -1)
    np.testing.assert_allclose(found, truth.stress[:, owners, 0], atol=truth.stress.max() / 65000)


def test_curves_are_the_errors_frame_by_frame():
    truth, prediction = plate(5), plate(5, seed=1)
    curves = encode.encode_curves(truth, [prediction, None])
    normal = truth.scene.node_type == NodeType.NORMAL
    free = truth.scene.node_type != NodeType.OBSTACLE
    for frame in range(5):
        error = (prediction.position - truth.position)[frame, normal].astype(float)
        assert curves["displacement"]["runs"][0][frame] == pytest.approx(np.sqrt(np.mean(error**2)))
        still = (truth.position[0] - truth.position[frame])[normal].astype(float)
        assert curves["displacement"]["trivial"][frame] == pytest.approx(np.sqrt(np.mean(still**2)))
        true = truth.stress[frame, free].astype(float)
        assert curves["stress"]["trivial"][frame] == pytest.approx(np.std(true), abs=1e-6)
        wrong = prediction.stress[frame, free] - true
        assert curves["stress"]["runs"][0][frame] == pytest.approx(np.sqrt(np.mean(wrong**2)), abs=1e-6)
    assert curves["displacement"]["runs"][1] is None and curves["stress"]["runs"][1] is None
    assert max(curves["displacement"]["runs"][0]) > 1e-3


def test_a_prediction_ends_at_its_first_frame_that_is_not_finite():
    truth, prediction = plate(5), plate(5, seed=1)
    prediction.position[3, 7] = np.nan
    encoded = encode.encode_scene(truth, np.arange(5), [prediction])
    assert encoded["predictions"][0]["frames"] == 3
    assert len(encode.encode_curves(truth, [prediction])["displacement"]["runs"][0]) == 3


def test_a_prediction_without_a_finite_frame_has_no_errors():
    truth, prediction = plate(5), plate(5, seed=1)
    prediction.position[:] = np.nan
    curves = encode.encode_curves(truth, [prediction])
    assert curves["displacement"]["runs"] == [[]] and len(curves["displacement"]["trivial"]) == 5


def test_large_scenes_show_fewer_frames_but_all_errors(monkeypatch):
    monkeypatch.setattr(report, "MOTION_BYTES", 200_000)
    truth = plate(61)
    scenes = report.page_data([one_run(plate=(truth, plate(61, seed=1)))])["scenes"]
    cost = encode.motion_bytes(truth) * 2
    assert scenes[0]["frames"] == list(range(0, 61, -(-61 * cost // 200_000)))
    assert 12 <= len(scenes[0]["frames"]) < 61
    assert len(scenes[0]["curves"]["displacement"]["runs"][0]) == 61


def test_representative_scenes():
    errors = {"a": 3.0, "b": 1.0, "c": 2.0, "d": float("nan"), "e": 0.5}
    assert report.representative(errors) == [("Best", "e"), ("Median", "c"), ("Worst", "d")]
    assert report.representative({"a": 2.0, "b": 1.0}) == [("Best", "b"), ("Worst", "a")]
    assert report.representative({"a": 2.0}) == [("Only scene", "a")]
    assert report.representative({}) == []


def test_all_conventions_stand_beside_the_trivial_predictors():
    first, second = tables.measure_tables(["AST"], [evaluation({"a": 1e-3})])
    assert first["columns"] == ["AST", "Hold still", "Repeat the last increment"]
    assert second["columns"] == ["AST", "Zero", "Constant mean", "Mean of the frame"]
    assert len([row for row in first["rows"] if "values" in row]) == 8
    assert first["rows"][0] == {"group": "Full rollout"}
    assert first["rows"][1] == {"label": "rmse_sequence", "note": "NORMAL nodes", "values": [1.43e-3, 6.5e-3, 6.5e-3]}
    assert second["rows"][2]["values"] == pytest.approx([7458.0, 22770.0, 17380.0, 12430.0])


def test_the_first_50_steps_are_shown_where_a_rollout_has_more():
    for frames, shown in ((51, False), (52, True)):
        found = evaluation({"a": 1e-3, "b": 2e-3})
        found = replace(found, scenes=(found.scenes[0], replace(found.scenes[1], frames=frames)))
        for table in tables.measure_tables(["AST"], [found]):
            assert ({"group": "First 50 steps of the rollout"} in table["rows"]) is shown


def test_the_lead_names_the_run_once():
    lead = report.page_data([one_run("run", "ast")])["lead"]
    assert lead.startswith("“run” predicts scenes that it never saw") and lead.lower().count("run") == 1


def test_the_column_of_one_run_is_headed_by_its_model():
    for model, title in (("ast", "AST"), ("mgn", "MGN"), ("transolver", "Transolver"), ("my-net", "my-net")):
        page_data = report.page_data([one_run("first", model)])
        assert [table["columns"][0] for table in page_data["tables"]] == [title, title]
    both = report.page_data([one_run("first", "mgn"), one_run("second", "mgn")])
    assert both["tables"][0]["columns"][:2] == ["first", "second"]


def test_an_element_that_holds_an_obstacle_node_is_shown_as_rigid():
    groups = encode.Boundary(two_tetrahedra()).groups
    for name, element, nodes in (("body", 0, [0, 1, 2, 3]), ("obstacle", 1, [1, 2, 3, 4])):
        assert groups[name][1].tolist() == nodes and groups[name][2].tolist() == [element] * 3


def test_a_run_that_jumps_has_no_figure_of_one_step():
    stepwise = evaluation({"a": 1e-3})
    kept = [row for row in stepwise.errors if (row.predictor, row.horizon) != ("model", "one_step")]
    runs = [stepwise, replace(stepwise, jumps=True, errors=tuple(kept))]
    for table in tables.measure_tables(["stepwise", "jumps"], runs):
        values, horizon = {}, None
        for row in table["rows"]:
            horizon = row.get("group", horizon)
            if "values" in row:
                values.setdefault(horizon, []).append(row["values"])
        assert all(step is not None and none is None for step, none, *_ in values["One step"])
        assert all(step == same for step, same, *_ in values["Full rollout"])


def test_scenes_are_ranked_and_failures_come_last():
    found = tables.samples([evaluation({"a": 3e-3, "b": None, "c": 1e-3})], ["run"])
    assert [found["names"][i] for i in found["order"]] == ["c", "a", "b"]
    assert found["runs"] == [[3e-3, None, 1e-3]]
    assert found["trivial"] == [6e-3] * 3
    labels = [column["label"] for column in found["table"]]
    assert labels == ["Nodes", "Frames", "Displacement", "Hold still", "Stress", "Model’s step", "Solver’s step"]
    assert found["table"][5]["values"] == [0.002, None, 0.002]


def test_tiles_state_ratio_speed_and_failures():
    found = {tile["label"]: tile for tile in tables.tiles(evaluation({"a": 3e-3, "b": None}))}
    assert found["Displacement error"]["value"] == 1.43e-3
    assert found["Displacement error"]["detail"].startswith("22 % of “hold still”")
    assert found["Stress error"]["detail"].startswith("60 % of “mean of the frame”")
    assert found["Time per step"]["value"] == 0.002 and "34 ms" in found["Time per step"]["detail"]
    assert found["Speed-up over the solver"]["value"] == "17"
    assert found["Test scenes"]["value"] == "2" and found["Test scenes"]["detail"] == "1 rollout failed"


def test_a_tile_states_the_deepest_frame_beside_the_solver():
    solver = Beside(scenes=3, seconds=0.0612, model_seconds=0.025, ratio=2.4)
    deepest = replace(NO_DEEPEST, relative_error=0.0577, seconds=0.025, solver=solver)
    found = {tile["label"]: tile for tile in tables.tiles(evaluation({"a": 3e-3}, deepest=deepest))}
    tile = found["Deepest frame alone"]
    assert (tile["value"], tile["suffix"]) == ("5.77", "%")
    assert tile["detail"] == "of the displacement, 25 ms on one thread; the solver: 61.2 ms"
    for missing in (replace(deepest, solver=None), replace(deepest, relative_error=None)):
        tiles = {tile["label"]: tile for tile in tables.tiles(evaluation({"a": 3e-3}, deepest=missing))}
        assert "solver" not in tiles.get("Deepest frame alone", {"detail": ""})["detail"]


def test_a_failed_rollout_has_no_figure():
    failed = evaluation({"a": None})
    errors = [replace(row, rmse_sequence=None) if row.predictor == "model" else row for row in failed.errors]
    tile = tables.tiles(replace(failed, errors=tuple(errors)))[0]
    assert tile["value"] is None and tile["detail"] == "no figure, because a rollout failed"


def test_training_curves_are_thinned_to_means():
    losses, validation = tables.training_curves(metrics(1000))
    assert [curve["name"] for curve in losses] == ["Loss", "Motion", "Stress"]
    assert len(losses[0]["y"]) == 400
    assert losses[0]["y"][0] == pytest.approx((2 / 1 + 2 / 2 + 2 / 3) / 3)
    assert validation[0]["x"] == [100, 200, 400, 500, 600, 700, 800, 900, 1000]
    assert validation[0]["y"][1] == pytest.approx(0.002)


def test_the_page_is_one_small_file(tmp_path):
    path = tmp_path / "report.html"
    report.write(path, [one_run(plate=(plate(41), plate(41, seed=1)))], "Plates")
    text = path.read_text(encoding="utf-8")
    assert len(text) < 10_000_000
    assert not re.search(r"<(link|img|iframe|script)[^>]*\s(src|href)=", text)
    assert "{{" not in text.split("<script", 1)[0]
    assert list(tmp_path.iterdir()) == [path]


def test_data_cannot_end_its_element():
    data = report.page_data([one_run(**{"</script><script>x": (strip(2), strip(2))})])
    text = page.render(data, "<title>")
    inside = text.split('id="report-data">', 1)[1].split("</script>", 1)[0]
    assert json.loads(inside)["scenes"][0]["name"] == "</script><script>x"
    assert "<title>&lt;title&gt;</title>" in text


def test_no_number_that_json_does_not_know():
    damaged = evaluation({"a": float("nan")}, speedup=float("inf"))
    run = report.ReportRun("run", "ast", [], damaged, [{"step": 1, "loss": float("nan")}])
    json.dumps(report.page_data([run]), allow_nan=False)


def test_a_run_without_anything_still_has_a_page(tmp_path):
    report.write(tmp_path / "a.html", [report.ReportRun("empty", "ast", [])], "Nothing yet")
    assert (tmp_path / "a.html").stat().st_size > 1_000_000


@pytest.mark.parametrize("count", [0, 7])
def test_number_of_runs(tmp_path, count):
    with pytest.raises(AstSimError, match=f"1 to 6 runs, not {count}"):
        report.write(tmp_path / "a.html", [report.ReportRun("run", "ast", [])] * count, "Runs")


def test_prediction_of_another_scene_is_refused(tmp_path):
    with pytest.raises(AstSimError, match="59 nodes and 82 elements"):
        report.write(tmp_path / "a.html", [one_run(plate=(plate(2), strip(2)))], "Plates")
    assert list(tmp_path.iterdir()) == []


def test_folder_that_does_not_exist(tmp_path):
    with pytest.raises(AstSimError, match="cannot be written .No such file"):
        report.write(tmp_path / "absent" / "a.html", [report.ReportRun("run", "ast", [])], "Runs")


def test_missing_plotly_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(MissingExtra, match=r'pip install "ast_sim\[view\]"'):
        report.write(tmp_path / "a.html", [report.ReportRun("run", "ast", [])], "Runs")


def test_fewer_stress_rows_than_the_truth_has():
    truth, prediction = plate(3), plate(3, stress="none", seed=1)
    curves = encode.encode_curves(truth, [Trajectory(truth.scene, prediction.position)])
    assert curves["stress"]["runs"] == [None]
    assert len(curves["displacement"]["runs"][0]) == 3
