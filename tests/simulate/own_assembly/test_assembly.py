"""Assemblies of a user, solved by the real solver: units, places far away, three parts, surfaces, CAD, scripts."""

import json
from dataclasses import replace

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, write_assembly, write_box

from ast_sim.dataset.reader import Dataset
from ast_sim.scene import NodeType
from ast_sim.simulate.families import assembly
from ast_sim.simulate.jobs.fastest_solver import VARIANTS, SolverVariant, solver_outcomes
from ast_sim.simulate.jobs.generate import generate
from ast_sim.simulate.jobs.recipe import recipe_of
from ast_sim.simulate.jobs.samples import draw_sample
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.parts import volumes
from ast_sim.support.errors import ConfigError, SimulationError

STEP = """
import gmsh, sys
gmsh.initialize(interruptible=False)
gmsh.option.setNumber("General.Terminal", 0)
gmsh.model.occ.addBox(0, 0, 0, 10, 10, 5)
gmsh.model.occ.synchronize()
gmsh.write(sys.argv[1])
"""


def scene_of(path, nodes=None, **given):
    spec = read_spec(path)
    return assembly.scene_of(spec, completed(spec.parameters, given), nodes, spec.frames)


def solved(path, **given):
    spec = read_spec(path)
    made = scene_of(path, **given)
    found = assembly.in_newton(assembly.solve(made.case), spec.unit)
    assert found.attributes["status"] == "complete", found.attributes.get("stopped_by")
    assert found.attributes["min_gap"] > 0 and found.attributes["min_jacobian"] > 0
    assert max(found.attributes["residual"]) <= 1
    return made, found


def test_millimetres_and_metres_give_the_same_mechanics(tmp_path):
    folders = [tmp_path / unit for unit in ("mm", "m")]
    for folder in folders:
        folder.mkdir()
    metres = SPEC.replace('"mm"', '"m"').replace("0.05", "5e-5").replace("[0.5, 1.5]", "[0.5e-3, 1.5e-3]")
    _, first = solved(write_assembly(folders[0]))
    _, second = solved(write_assembly(folders[1], metres, scale=1e-3))
    np.testing.assert_allclose(second.position, 1e-3 * first.position, rtol=0, atol=2e-6 * 0.01)
    np.testing.assert_allclose(second.stress, first.stress, rtol=0, atol=1e-3 * first.stress.max())
    for name in ("reaction", "elastic_energy", "work"):
        np.testing.assert_allclose(second.attributes[name], first.attributes[name], rtol=1e-2)
    # 0.8 mm of 5 mm under 16 mm^2, or under the 56 mm^2 around the touched nodes of so coarse a mesh; the modulus of
    # uniaxial strain is 2 MPa.
    assert 5 < first.attributes["reaction"][-1] < 30


def test_parts_of_micrometres_are_solved_in_metres(tmp_path):
    spec = SPEC.replace('"mm"', '"m"').replace("0.05", "5e-8").replace("[0.5, 1.5]", "[0.5e-6, 1.5e-6]")
    first, second = tmp_path / "mm", tmp_path / "m"
    first.mkdir(), second.mkdir()
    _, large = solved(write_assembly(first), travel=1.0)
    _, small = solved(write_assembly(second, spec, scale=1e-6), travel=1e-6)
    np.testing.assert_allclose(small.position, 1e-6 * large.position, rtol=0, atol=2e-6 * 1e-5)
    np.testing.assert_allclose(small.attributes["reaction"], 1e-6 * np.array(large.attributes["reaction"]), rtol=1e-3)


def test_far_from_the_origin_nothing_changes(tmp_path):
    near, far = tmp_path / "near", tmp_path / "far"
    near.mkdir(), far.mkdir()
    shift = (250_000.0, -40_000.0, 13_000.0)
    _, first = solved(write_assembly(near))
    _, second = solved(write_assembly(far, shift=shift))
    origin = np.array(second.attributes["origin"])
    assert first.attributes["origin"] == [0, 0, 0]
    np.testing.assert_allclose(second.position + (origin - shift), first.position, rtol=0, atol=1e-4)
    np.testing.assert_allclose(second.attributes["reaction"], first.attributes["reaction"], rtol=1e-3, atol=1e-6)


def test_three_parts_with_friction_of_their_own(tmp_path):
    write_box(tmp_path / "cover.vtu", (2.2, 2.2, 5.2), (7.8, 7.8, 7.2), (3, 3, 1))
    spec = SPEC.replace("[parts.punch]", """[parts.cover]
file = "cover.vtu"
young = 1e6
poisson = 0.3
move = { where = "zmax", translation = ["aside", 0, "-0.5 * travel"] }

[parts.punch]
offset = [0, 0, 40]""")  # fmt: skip
    spec = spec.replace("[parameters]", "[parameters]\naside = 0.6\nrough = [0.0, 0.8]")
    pairs = '[[contact]]\nparts = ["cover", "block"]\nfriction = "rough"\n'
    path = write_assembly(tmp_path, pairs + spec)
    path.write_text(spec + pairs)
    made, sticky = solved(path, rough=0.8)
    _, smooth = solved(path, rough=0.0)
    assert np.unique(made.case.scene.body).tolist() == [0, 1, 2]
    assert made.case.scene.material.shape[1] == 3  # friction is drawn, so a model must see it
    assert np.unique(made.case.scene.material[:, 2]).tolist() == pytest.approx([0.0, 0.8])
    top = (made.case.scene.body == 0) & (made.case.scene.rest_position[:, 2] == 5)
    dragged = [found.position[-1, top, 0].mean() - found.position[0, top, 0].mean() for found in (sticky, smooth)]
    assert dragged[0] > 0.1 > 3 * abs(dragged[1])
    assert sticky.attributes["dissipation"][-1] > 0 == smooth.attributes["dissipation"][-1]


def test_the_friction_of_two_parts_is_recorded(tmp_path):
    """A model knows the friction that the dataset records. Two rigid parts do not rub on each other."""
    pair = '[[contact]]\nparts = ["block", "punch"]\nfriction = 0.4\n'
    write_box(tmp_path / "back.vtu", (3, 3, 9), (7, 7, 10), (1, 1, 1))
    back = '[parts.back]\nfile = "back.vtu"\nrigid = true\n' + pair.replace("punch", "back")
    for spec in (SPEC + pair, SPEC + back + pair):
        made, found = solved(write_assembly(tmp_path, spec), travel=0.5)
        assert found.attributes["friction"] == 0.4 and made.case.contact.friction == 0
    others = SPEC + back.replace("0.4", "0.1") + pair
    contact, scene = (made := scene_of(write_assembly(tmp_path, others)).case).contact, made.scene
    assert contact.frictions(scene) == [0.1, 0.4]
    assert replace(contact, self_contact=(0,)).frictions(scene) == [0, 0.1, 0.4]


def test_rigid_parts_may_touch_and_pass_each_other(tmp_path):
    """A tool of two parts that share a face, and a guide that it moves into: nothing gives way there."""
    write_box(tmp_path / "back.vtu", (3, 3, 8), (7, 7, 9), (1, 1, 1))
    write_box(tmp_path / "guide.vtu", (3, 3, 10), (7, 7, 12), (2, 2, 2))
    parts = ["back", "guide"]
    more = "".join(f'[parts.{name}]\nfile = "{name}.vtu"\nrigid = true\nmove = {{MOVE}}\n' for name in parts)
    more = more.replace("{MOVE}", "{ translation = [0, 0, '-travel'] }", 1)
    more = more.replace("{MOVE}", "{ translation = [0, 0, '-3 * travel'] }")
    alone, together = tmp_path / "alone", tmp_path / "together"
    for folder, spec in ((alone, SPEC), (together, SPEC + more)):
        folder.mkdir()
        for name in parts:
            (folder / f"{name}.vtu").write_bytes((tmp_path / f"{name}.vtu").read_bytes())
        write_assembly(folder, spec)
    made, first = solved(alone / "SPEC.toml", travel=1.0)
    _, second = solved(together / "SPEC.toml", travel=1.0)
    count = made.case.scene.num_nodes
    np.testing.assert_allclose(second.position[:, :count], first.position, rtol=0, atol=1e-6)


def test_a_rigid_surface_is_a_tool(tmp_path):
    """A single sheet of triangles above the block: the block touches the sheet, not the layer behind it."""
    path = write_assembly(tmp_path, SPEC.replace('"punch.vtu"', '"sheet.stl"'))
    corners = np.array([[2, 2, 5.2], [8, 2, 5.2], [8, 8, 5.2], [2, 8, 5.2], [5, 5, 5.2]])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    meshio.Mesh(corners, {"triangle": triangles}).write(path.parent / "sheet.stl")
    made, found = solved(path, travel=1.2)
    scene = made.case.scene
    tool = scene.node_type == NodeType.OBSTACLE
    assert tool.sum() == 10 and np.array_equal(tool, scene.body == 1)
    assert volumes(scene.rest_position.astype(float), scene.elements).min() > 0
    lowest = scene.rest_position[tool, 2].min()
    assert lowest == pytest.approx(5.2) and scene.rest_position[tool, 2].max() > 6
    under = (scene.body == 0) & (scene.rest_position == np.float32([5, 5, 5])).all(axis=1)
    assert found.position[-1, under, 2] == pytest.approx(4.0, abs=0.06)


def test_step_files_are_taken_in_the_unit_of_the_specification(tmp_path):
    import subprocess
    import sys

    subprocess.run([sys.executable, "-c", STEP, str(tmp_path / "block.step")], check=True, capture_output=True)
    finer = "finer = { low = [2, 2, 3], high = [8, 8, 6], size = 1.2 }\n"
    for unit, length in (("mm", 10), ("m", 0.01)):
        spec = SPEC.replace('"mm"', f'"{unit}"').replace('"block.vtu"', f'"block.step"\nsize = {0.3 * length}')
        if unit == "mm":
            spec = spec.replace("poisson", finer + "poisson")
        else:
            spec = spec.replace("0.05", "5e-5").replace("[0.5, 1.5]", "[0.5e-3, 1.5e-3]")
        path = write_assembly(tmp_path, spec, scale=length / 10)
        scene = scene_of(path).case.scene
        block = scene.rest_position[scene.body == 0]
        np.testing.assert_allclose([block.min(axis=0), block.max(axis=0)], [[0, 0, 0], [length, length, length / 2]],
                                   atol=1e-6 * length)  # fmt: skip
        if unit == "mm":
            inside = ((block > [2, 2, 3]) & (block < [8, 8, 6])).all(axis=1)
            assert inside.sum() == pytest.approx(0.72 * 72 / 1.2**3 + 1.4 * 36 / 1.2**2, rel=0.4)
    coarse, fine = (scene_of(path, nodes=nodes).case.scene for nodes in (100, 600))
    assert coarse.num_nodes == pytest.approx(100, rel=0.25) and fine.num_nodes == pytest.approx(600, rel=0.12)


def test_scripts_variants_and_self_contact(tmp_path):
    """A Python function and a .geo script make variants of one part, with groups; the slit of one closes on itself."""
    (tmp_path / "clip.py").write_text("""
def clip(gmsh, height):
    occ = gmsh.model.occ
    block, slit = occ.addBox(0, 0, 0, 10, 4, height), occ.addBox(-1, -1, height / 2 - 0.25, 9, 6, 0.5)
    occ.cut([(3, block)], [(3, slit)])
    occ.synchronize()
    low = [tag for dim, tag in gmsh.model.getEntities(2) if gmsh.model.getBoundingBox(dim, tag)[5] < 1e-3]
    gmsh.model.addPhysicalGroup(2, low, name="base")
""")
    (tmp_path / "clip.geo").write_text("""
SetFactory("OpenCASCADE");
DefineConstant[ height = 1 ];
Box(1) = {0, 0, 0, 10, 4, height};
Physical Surface("base") = {5};
""")
    spec = """
unit = "mm"
frames = 3
friction = 0.4
contact_distance = 0.04
[parameters]
height = [3.5, 4.5]
[parts.clip]
file = ["clip.py:clip", "clip.geo"]
arguments = { height = "height" }
size = 1.2
young = 1e7
poisson = 0.3
fixed = "group=base"
self_contact = true
[parts.punch]
file = "punch.vtu"
rigid = true
offset = [-2, -3, "height - 5"]
tilt = { rotation = 3, axis = [0, 1, 0], point = [5, 5, 5.2] }
move = { translation = [[0, 0, -0.6], [0.2, 0, -0.9]] }
"""
    path = write_assembly(tmp_path, spec)
    made, closed = solved(path, height=4.0)
    scene = made.case.scene
    rest = scene.rest_position
    assert rest[scene.body == 0].max(axis=0) == pytest.approx([10, 4, 4])
    assert np.array_equal(scene.node_type == NodeType.HANDLE, (rest[:, 2] < 1e-6) & (scene.body == 0))
    lips = [(scene.body == 0) & (np.abs(rest - [0, 2, z]) < [1.5, 3, 1e-3]).all(axis=1) for z in (1.75, 2.25)]
    apart = closed.position[-1, lips[1], 2].mean() - closed.position[-1, lips[0], 2].mean()
    assert all(lip.any() for lip in lips) and 0 < apart < 0.1  # from 0.5
    whole = scene_of(path, **{"clip.file": "clip.geo", "height": 4.5}).case.scene
    assert whole.rest_position[whole.body == 0].max(axis=0) == pytest.approx([10, 4, 4.5])
    assert volumes(whole.rest_position, whole.elements)[whole.body[whole.elements[:, 0]] == 0].sum() == pytest.approx(
        180
    )


def test_the_bytes_do_not_depend_on_workers(tmp_path):
    path = write_assembly(tmp_path)
    counts = {"train": 3, "valid": 1, "test": 0, "progress": False}
    for workers in (1, 2):
        generate("assembly", tmp_path / f"{workers}.h5", spec=path, workers=workers, **counts)
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()
    with Dataset(tmp_path / "1.h5") as data:
        info, truth = data.info, data["train"][1]
        given = [data["train"][i].attributes["parameter travel"] for i in range(3)]
    assert info.length_unit == "mm" and info.generator["spec"]["text"] == SPEC and len(set(given)) == 3
    assert info.generator["command"] == "ast-sim generate assembly SPEC.toml --seed 0 --frames 3"
    recipe = recipe_of("1.h5", info, path)
    again = draw_sample(recipe, "train", 1)
    assert np.array_equal(again.case.scene.rest_position, truth.scene.rest_position)
    assert truth.position[-1, -1, 2] - truth.position[0, -1, 2] == pytest.approx(-given[1], abs=1e-6)
    assert json.loads(json.dumps(info.generator)) == info.generator


def test_other_contents_are_another_dataset(tmp_path):
    path, out = write_assembly(tmp_path), tmp_path / "a.h5"
    counts = {"train": 1, "valid": 0, "test": 0, "workers": 1, "progress": False}
    generate("assembly", out, spec=path, **counts)
    write_box(tmp_path / "punch.vtu", (3, 3, 5.3), (7, 7, 8), (2, 2, 2))
    with pytest.raises(ConfigError, match="holds other data .spec: files: punch.vtu"):
        generate("assembly", out, spec=path, **counts)
    with Dataset(out) as data:
        info = data.info
    with pytest.raises(ConfigError, match="SPEC.toml or a file that it names differs from what a.h5 was made of"):
        recipe_of("a.h5", info, path)
    with pytest.raises(ConfigError, match="a.h5 was made of a specification: say where to find that"):
        recipe_of("a.h5", info)


def test_a_part_that_was_changed_is_read_again(tmp_path):
    path = write_assembly(tmp_path)
    before = scene_of(path).case.scene
    write_box(tmp_path / "punch.vtu", (3, 3, 5.5), (7, 7, 8), (2, 2, 2))
    after = scene_of(path).case.scene
    lowest = [scene.rest_position[scene.body == 1, 2].min() for scene in (before, after)]
    assert lowest == pytest.approx([5.2, 5.5])


def test_the_same_scene_on_a_coarser_mesh(tmp_path):
    path = write_assembly(tmp_path, SPEC.replace('"block.vtu"', '"made.py"\nsize = 1.5'))
    (tmp_path / "made.py").write_text("def make(gmsh):\n    gmsh.model.occ.addBox(0, 0, 0, 10, 10, 5)\n")
    drawn = scene_of(path)
    coarse = drawn.remesh(0.5)
    of_block = [(case.scene.body == 0).sum() for case in (drawn.case, coarse)]
    assert 0.35 < of_block[1] / of_block[0] < 0.7
    assert np.array_equal(coarse.prescribed_position[-1, -1], drawn.case.prescribed_position[-1, -1])
    with pytest.raises(SimulationError, match="there is no coarser mesh"):
        scene_of(write_assembly(tmp_path)).remesh(0.5)


def test_the_solver_goes_straight_to_a_frame(tmp_path):
    """In the dataset's own way and on a coarser mesh, from the specification that the dataset was made of."""
    path = write_assembly(tmp_path, SPEC.replace('"block.vtu"', '"made.py"\nsize = 1.8'))
    (tmp_path / "made.py").write_text("def make(gmsh):\n    gmsh.model.occ.addBox(0, 0, 0, 10, 10, 5)\n")
    out = tmp_path / "study.h5"
    generate("assembly", out, spec=path, train=0, valid=0, test=1, workers=1, progress=False)
    variants = (VARIANTS[0], SolverVariant("half", nodes=0.5))
    (found,) = solver_outcomes(out, "test", [0], variants=variants, starts=(1,), made_from=path, progress=False)
    own, coarse = found.outcomes
    assert found.frame == 2 and own.converged and coarse.converged, (own.failure, coarse.failure)
    assert own.relative_error < 0.02 and own.relative_error < coarse.relative_error < 0.8
    assert coarse.nodes < 0.75 * own.nodes
    with pytest.raises(ConfigError, match="was made of a specification: say where to find that"):
        solver_outcomes(out, "test", [0], progress=False)


def test_with_friction_only_the_walk_ends_at_the_dataset(tmp_path):
    """The punch comes down, then rubs sideways; half of the frames are kept. A straight path has not rubbed."""
    there = "[[0, 0, 0], [0, 0, '-travel'], ['travel', 0, '-travel']]"
    spec = SPEC.replace("[0, 0, '-travel']", there).replace("frames = 3", "frames = 9\nfriction = 0.4")
    path, out = write_assembly(tmp_path, spec), tmp_path / "rubbed.h5"
    generate("assembly", out, spec=path, train=0, valid=0, test=1, keep=(2, 4, 6, 8), workers=1, progress=False)
    variants = (VARIANTS[0], SolverVariant("frame by frame", every_frame=True))
    assert variants[1] in VARIANTS
    (found,) = solver_outcomes(
        out, "test", [0], lambda _: 4, variants=variants, starts=(1,), made_from=path, progress=False
    )
    straight, stepped = found.outcomes
    assert stepped.converged and stepped.relative_error < 1e-6 and stepped.start == 0
    assert straight.relative_error > 0.02


def test_a_draw_that_cannot_stand_is_drawn_again(tmp_path):
    """Both ends of each range are fine, but not where they come together."""
    spec = SPEC.replace("[0.5, 1.5]", "[0.5, 1.5]\na = [0, 0.22]\nb = [0, 0.22]")
    spec = read_spec(write_assembly(tmp_path, spec.replace("rigid", 'offset = [0, 0, "0.1 - a - b"]\nrigid')))
    assembly.check_spec(replace(spec), None, spec.frames)
    again = [assembly.draw_scene(spec, (0, 0, i), None, 3).case.attributes["redrawn"] for i in range(12)]
    assert 0 < sum(map(bool, again)) < 12
