"""ParaView's own readers (through pyvista) read back what was written, number for number."""

from __future__ import annotations

import errno
from dataclasses import replace

import meshio
import numpy as np
import pytest
import pyvista
import toy
from data_samples import block, raised, trajectory
from view_scenes import plate, strip
from vtk_series import read

from ast_sim.inference.answer import Answer
from ast_sim.scene import Trajectory
from ast_sim.support.errors import AstSimError, DatasetError
from ast_sim.view import export

CELL_TYPE = {3: pyvista.CellType.TRIANGLE, 4: pyvista.CellType.TETRA, 10: pyvista.CellType.QUADRATIC_TETRA}

QUADRATIC = trajectory(raised(block(2, 1, 1)), 2, stress="node")


def same(found, expected):
    """Equal in value and in precision."""
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
@pytest.mark.parametrize(
    "truth", [plate(5), plate(3, stress="element"), plate(2, stress="none"), strip(4), plate(1), QUADRATIC]
)
def test_trajectory_reads_back(tmp_path, suffix, truth):
    path = tmp_path / f"plate & <ball>{suffix}"
    truth = replace(truth, times=tuple(i * 0.1 for i in range(truth.num_frames)))
    export.write(path, truth)
    times, meshes = read(path)
    assert times == [i * 0.1 for i in range(truth.num_frames)]
    scene, at_nodes = truth.scene, truth.stress is not None and truth.stress.shape[1] == truth.scene.num_nodes
    for frame, mesh in enumerate(meshes):
        same(mesh.points, truth.position[frame])
        k = scene.elements.shape[1]
        assert (mesh.celltypes == CELL_TYPE[k]).all()
        np.testing.assert_array_equal(mesh.cells.reshape(-1, k + 1)[:, 1:], scene.elements)
        same(mesh.point_data["displacement"], truth.position[frame] - scene.rest_position)
        same(mesh.point_data["node_type"], scene.node_type)
        same(mesh.point_data["body"], scene.body)
        if truth.stress is None:
            assert "von_mises" not in mesh.point_data and "von_mises" not in mesh.cell_data
        else:
            same((mesh.point_data if at_nodes else mesh.cell_data)["von_mises"], truth.stress[frame, :, 0])


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
@pytest.mark.parametrize("stress", ["node", "element"])
def test_prediction_carries_its_errors(tmp_path, suffix, stress):
    truth, prediction = plate(5, stress=stress), plate(5, stress=stress, seed=1)
    short = Trajectory(truth.scene, prediction.position[:3], prediction.stress[:3], {"status": "truncated"})
    path = tmp_path / f"prediction{suffix}"
    export.write(path, truth, short)
    times, meshes = read(path)
    assert times == [0.0, 1.0, 2.0]
    for frame, mesh in enumerate(meshes):
        error = prediction.position[frame] - truth.position[frame]
        same(mesh.points, prediction.position[frame])
        same(mesh.point_data["error"], error)
        np.testing.assert_allclose(mesh.point_data["error_magnitude"], np.sqrt((error**2).sum(1)), rtol=1e-6)
        data = mesh.point_data if stress == "node" else mesh.cell_data
        same(data["von_mises"], prediction.stress[frame, :, 0])
        same(data["von_mises_error"], prediction.stress[frame, :, 0] - truth.stress[frame, :, 0])
    assert np.abs(meshes[2].point_data["error"]).max() > 1e-3


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_errors_compare_the_frames_with_the_same_numbers(tmp_path, suffix):
    """A prediction of the frames 2 and 4 is compared with these frames of the truth, not with its first two."""
    truth, path = plate(5), tmp_path / f"some{suffix}"
    predicted = truth.position[[2, 4]] + np.float32(0.5)
    some = Trajectory(truth.scene, predicted, truth.stress[[2, 4]], frames=(2, 4))
    export.write(path, truth, some)
    times, meshes = read(path)
    assert times == [2.0, 4.0]
    for mesh in meshes:
        np.testing.assert_allclose(mesh.point_data["error"], 0.5, atol=1e-6)
        assert not mesh.point_data["von_mises_error"].any()
    export.write(path, replace(truth, times=(0.0, 0.1, 0.25, 0.5, 1.0)), replace(some, times=(0.25, 1.0)))
    assert read(path)[0] == [0.25, 1.0]
    with pytest.raises(DatasetError, match="there is no frame 5; there are the frames 0 to 4"):
        export.write(path, truth, replace(some, frames=(4, 5)))


NOTES = 'größer <als> & --move; in training "0 m" ---'


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
@pytest.mark.parametrize("notes", [{}, {"notes": NOTES}])
def test_files_hold_the_bands_of_an_answer_and_its_notes(tmp_path, suffix, notes):
    bands = {"displacement_band": [0.0, 0.5, 0.1], "reaction_band": [0.0, 1e-12, 3e9]}
    path = tmp_path / f"a{suffix}"
    export.write(path, replace(plate(3), attributes={**bands, **notes}))
    _, meshes = read(path)
    for frame, mesh in enumerate(meshes):
        assert {name: mesh.field_data[name].tolist() for name in bands} == {n: [b[frame]] for n, b in bands.items()}
        if suffix == ".vtkhdf" and notes:
            assert mesh.field_data["notes"].tolist() == [NOTES]
    if suffix == ".pvd":
        comment = '<!-- notes: größer <als> & - -move; in training "0 m" - - - -->'
        assert (comment in path.read_text(encoding="utf-8")) == bool(notes)
        assert meshio.read(tmp_path / "a" / "frame_00001.vtu").points.shape == meshes[1].points.shape
    some = replace(plate(3), attributes={**bands, **notes, "my_band": "blue"}).select([2])
    export.write(path, some)  # whose bands are not known: the list begins with the one of frame 0
    assert not any(name in read(path)[1][0].field_data for name in bands)


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_lengths_of_an_answer_stay_in_its_unit(tmp_path, suffix):
    """In millimetres, if its positions are. A file names no unit of length, so it names no metre."""
    metres = plate(3)
    scene = replace(metres.scene, rest_position=1000 * metres.scene.rest_position)
    info = replace(toy.info(), length_unit="mm")
    position = 1000 * metres.position
    answer = Answer("plate", scene, position, metres.stress, 1, [0.1], None, info, {}, "node", (0, 1, 2))
    answer.save(tmp_path / f"a{suffix}")
    moved = metres.position - metres.scene.rest_position
    for frame, mesh in enumerate(read(tmp_path / f"a{suffix}")[1]):
        same(mesh.points, position[frame])
        same(mesh.point_data["displacement"], answer.displacement[frame])
        np.testing.assert_allclose(mesh.point_data["displacement"], 1000 * moved[frame], atol=1e-4)
        same(answer.to_pyvista(frame).point_data["displacement"], answer.displacement[frame])
        assert set(mesh.point_data.keys()) == {"displacement", "von_mises", "node_type", "body"}
    assert np.abs(moved).max() > 0.03
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert files and not any(b"[m]" in file.read_bytes() for file in files)


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_a_second_export_replaces_the_first(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    export.write(path, plate(4))
    export.write(path, strip(2))
    times, meshes = read(path)
    assert times == [0.0, 1.0]
    assert meshes[0].n_points == strip().scene.num_nodes
    expected = {"a.pvd", "a", "a/frame_00000.vtu", "a/frame_00001.vtu"} if suffix == ".pvd" else {"a.vtkhdf"}
    assert {str(f.relative_to(tmp_path)) for f in tmp_path.rglob("*")} == expected


@pytest.mark.parametrize("suffix", [".pvd", ".vtkhdf"])
def test_a_failed_export_leaves_the_former_one(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"a{suffix}"
    export.write(path, strip(3))
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(export, "_write_vtu" if suffix == ".pvd" else "_write_steps", full)
    with pytest.raises(AstSimError, match=r"a\.\w+ cannot be written \(No space left on device\)"):
        export.write(path, plate(5))
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before


def test_other_files_in_the_folder_are_not_touched(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "thesis.tex").write_text("mine")
    with pytest.raises(AstSimError, match="a, the folder for the VTU files, holds other files: choose another name"):
        export.write(tmp_path / "a.pvd", strip())
    assert (tmp_path / "a" / "thesis.tex").read_text() == "mine"


@pytest.mark.parametrize("name", ["a.stl", "a", "a.PVD"])
def test_unknown_suffix_names_the_supported_ones(tmp_path, name):
    with pytest.raises(AstSimError, match=r"\.pvd or \.vtkhdf"):
        export.write(tmp_path / name, strip())
    assert list(tmp_path.iterdir()) == []


def test_prediction_of_another_scene_is_refused(tmp_path):
    with pytest.raises(AstSimError, match="59 nodes and 82 elements"):
        export.write(tmp_path / "a.pvd", plate(2), strip(2))


def test_vtu_files_stand_alone(tmp_path):
    truth = plate(2)
    export.write(tmp_path / "a.pvd", truth)
    mesh = meshio.read(tmp_path / "a" / "frame_00001.vtu")
    same(mesh.points, truth.position[1])
