"""Scenes that no dataset holds: a plate and a punch from a mesh, predicted, and solved to know the truth."""

import time
import warnings
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch
import toy
from checks import made_once
from meshes import box_between, plate_and_punch
from vtk_series import read

from ast_sim import Dataset, DatasetWriter, Effort, Motion, Run, generate, read_scene, train
from ast_sim.cli import main
from ast_sim.demo import FAMILY, FRAMES, NODES
from ast_sim.inference import answering, trained_run
from ast_sim.mechanics.case import SolidCase
from ast_sim.runs.scope import middle_of
from ast_sim.scene import Scene
from ast_sim.simulate.families import deforming_plate
from ast_sim.support.errors import ConfigError, DatasetError, RolloutError

SIZE, CELLS, DEPTH = (0.48, 0.32, 0.03), (11, 8, 2), 0.045
KEPT = (4, 14, 24, 34)
PRESCRIBED = {"obstacles": [1], "clamps": ["0:xmin,xmax"]}
PRESS = {1: (0.0, 0.0, -DEPTH)}


def scene_of(size=SIZE, cells=CELLS, gap=0.008) -> Scene:
    return read_scene(plate_and_punch(size, cells, gap), **PRESCRIBED).scene


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """A run like the demo's, with as much data as in its quick form; its error is a hundredth of holding still."""

    def make(folder: Path) -> None:
        plates = {"nodes": NODES, "frames": FRAMES, "keep": KEPT, "workers": 1}
        generate(FAMILY, folder / "data.h5", train=16, valid=2, test=3, **plates)
        settings = {"mirror": ("x", "y"), "batch_size": 4, "peak_rate": 1e-3, "validate_every": 100}
        train(folder / "data.h5", folder / "run", steps=100, **settings)

    return Run(made_once(tmp_path_factory, "new_scene", make) / "run")


@pytest.fixture(scope="module")
def test_error(run) -> float:
    """The displacement error in metres on the test split."""
    return run.evaluate(solver_scenes=0).figures.error("displacement").rmse_sequence


def solved(scene: Scene, motion: Motion) -> np.ndarray:
    """[S, N, 3]: the positions that the bundled solver finds, with all that the family's scenes have in common."""
    targets = motion.position.astype(np.float64)
    case = SolidCase(scene, targets, deforming_plate.MATERIAL, deforming_plate.CONTACT, "node")
    truth = deforming_plate.solve(case)
    assert truth.attributes["status"] == "complete"
    return truth.position


def rmse(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference.astype(np.float64)))))


def predicted_without_warning(run: Run, *arguments, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return run.predict(*arguments, **options)


def test_a_plate_and_a_punch_are_predicted_as_well_as_the_test_scenes(run, test_error, tmp_path, capsys):
    mesh = plate_and_punch(SIZE, CELLS, gap=0.008)
    scene = read_scene(mesh, obstacles=[1], clamps=["0:xmin,xmax"]).scene
    answer = predicted_without_warning(run, scene, {1: (0, 0, -DEPTH)})
    assert answer.failure is None and answer.stress.shape == (*answer.position.shape[:2], 1)

    motion = Motion.of_bodies(scene, PRESS, len(answer.position))
    truth, free = solved(scene, motion), ~scene.prescribed
    assert np.array_equal(answer.position[:, ~free], motion.position[:, ~free])
    error = rmse((answer.position - truth)[1:, free])
    hold_still = rmse((truth - truth[0])[1:, free])
    assert error <= 2 * test_error
    assert error < 0.75 * hold_still

    # From the command line: the same numbers, in a file that VTK reads.
    meshio.write(tmp_path / "mesh.vtu", mesh)
    out = tmp_path / "answer.vtkhdf"
    options = ["--obstacle", "1", "--clamp", "0:xmin,xmax", "--move", f"1=0,0,-{DEPTH}", "--out", str(out)]
    capsys.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["predict", str(run.path), str(tmp_path / "mesh.vtu"), *options]) == 0
    shown = capsys.readouterr().out
    assert "body 0: 324 nodes (270 normal, 54 handle)" in shown and "body 1: 27 nodes (27 obstacle)" in shown
    assert f"{len(answer.position) - 1} frames predicted" in shown
    times, frames = read(out)
    assert len(times) == len(answer.position)
    for frame, found in enumerate(frames):
        assert np.array_equal(found.points, answer.position[frame])
        assert np.array_equal(found.point_data["von_mises"], answer.stress[frame, :, 0])
        assert np.array_equal(found.cells.reshape(-1, 5)[:, 1:], scene.elements)
    print(f"error {error:.3g} m, test split {test_error:.3g} m, holding still {hold_still:.3g} m")


def test_the_prescribed_nodes_move_as_far_in_a_frame_as_in_training(run, monkeypatch):
    usual = run.scope.usual_increment
    with Dataset(run.settings.data) as data:
        found = [
            np.linalg.norm(np.diff(truth.position[:, truth.scene.prescribed].astype(float), axis=0), axis=2).max(axis=1)
            for truth in data["train"]
        ]
    found = np.concatenate(found)
    assert usual == pytest.approx(np.median(found[found > 0]), rel=1e-6)
    scene = scene_of()
    answer = run.predict(scene, PRESS)
    assert len(answer.position) == 1 + int(np.ceil(DEPTH / usual))
    assert len(run.predict(scene, PRESS, num_frames=9).position) == 9
    monkeypatch.setattr(run, "scope", replace(run.scope, usual_increment=0.0))
    with pytest.raises(
        ConfigError,
        match=r"nothing is moved in the training scenes: say how many frames, num_frames=N \(--num-frames N\)",
    ):
        run.predict(scene, PRESS)


def with_positions(scene: Scene, positions: np.ndarray) -> Scene:
    return replace(scene, rest_position=positions.astype(np.float32))


def test_what_read_scene_returns_is_predicted_like_its_scene(run):
    read = read_scene(plate_and_punch(SIZE, CELLS, gap=0.008), **PRESCRIBED)
    whole, alone = (run.predict(one, PRESS, num_frames=4) for one in (read, read.scene))
    assert whole.scene is read.scene and whole.frames == alone.frames == (0, 1, 2, 3)
    assert np.array_equal(whole.position, alone.position) and np.array_equal(whole.stress, alone.stress)
    assert not np.array_equal(whole.position[3], whole.position[0])
    assert whole.expected_error == alone.expected_error is not None and whole.notes == alone.notes == ()


def test_a_scene_far_away_gets_the_same_answer_there(run, tmp_path):
    """Coordinates are multiples of 2^-12, so that float32 holds the moved ones exactly."""
    scene = scene_of()
    rest = np.round(scene.rest_position.astype(np.float64) * 4096) / 4096
    press, frames = {1: (0.0, 0.0, -3 / 64)}, 17
    free = ~scene.prescribed
    size = np.linalg.norm(np.ptp(rest, axis=0))
    for shift in ((4.0, -4.0, 2.0), (64.0, -32.0, 16.0)):
        there = with_positions(scene, rest + shift)
        way = np.clip(middle_of(there), run.scope.data.middle_low, run.scope.data.middle_high) - middle_of(there)
        known = run.predict(with_positions(scene, rest + shift + way), press, num_frames=frames)
        far = run.predict(there, press, num_frames=frames)
        assert far.scene is there and far.failure is None
        expected = known.position.astype(np.float64) - way
        assert np.array_equal(far.position[:, free], expected.astype(np.float32)[:, free])
        motion = Motion.of_bodies(there, press, frames)
        assert np.array_equal(far.position[:, ~free], motion.position[:, ~free])
        assert np.array_equal(far.stress, known.stress)
        if max(shift) == 4:
            assert np.abs(far.position - expected).max() < 1e-6 * size
    far.save(tmp_path / "far.h5")
    with Dataset(tmp_path / "far.h5") as kept:
        assert np.array_equal(kept["test"][0].position, far.position)


def test_a_scene_is_predicted_where_training_scenes_lay(run, monkeypatch):
    """Models that read positions know no other place. A motion that leaves the domain even there is put into the middle
    of the domain."""
    predicted = []
    jumps = answering.jumps

    def kept(model, questions, effort, progress):
        predicted.extend(questions)
        return jumps(model, questions, effort, progress)

    monkeypatch.setattr(answering, "jumps", kept)
    with Dataset(run.settings.data) as data:
        middles = np.array([middle_of(data["train"][index].scene) for index in range(16)])
    assert run.scope.data.middle_low == pytest.approx(middles.min(axis=0))
    assert run.scope.data.middle_high == pytest.approx(middles.max(axis=0))
    scene = scene_of()
    run.predict(scene, PRESS, num_frames=3)
    assert predicted[-1].scene is scene
    run.predict(with_positions(scene, scene.rest_position + [0.5, 0.1, 0.0]), PRESS, num_frames=3)
    assert middle_of(predicted[-1].scene)[:2] == pytest.approx(run.scope.data.middle_high[:2], abs=1e-6)
    with pytest.warns(UserWarning, match="prescribed nodes move"):  # up to x = 1.15 of 1
        run.predict(scene, {1: (1.1, 0.0, 0.0)}, num_frames=3)
    x = predicted[-1].prescribed_position[:, scene.prescribed, 0]
    assert x.min() == pytest.approx(-x.max()) and x.max() > 0.5


def test_scenes_of_a_dataset_that_lie_elsewhere_are_evaluated_as_they_are_predicted(
    run, test_error, tmp_path, monkeypatch
):
    shift = np.float32([0.37, 0, 0])
    with Dataset(run.settings.data) as data:
        truths = [data["test"][index] for index in range(3)]
        with DatasetWriter(tmp_path / "there.h5", replace(data.info, domain_center=(0.37, 0.0, 0.0))) as writer:
            for truth in truths:
                scene = with_positions(truth.scene, truth.scene.rest_position + shift)
                writer.add("test", replace(truth, scene=scene, position=truth.position + shift))
    middles = []
    jumps = answering.jumps

    def kept(model, questions, effort, progress):
        middles.extend(middle_of(question.scene)[0] for question in questions)
        return jumps(model, questions, effort, progress)

    monkeypatch.setattr(answering, "jumps", kept)
    evaluated = run.evaluate(tmp_path / "there.h5", solver_scenes=0).figures.error("displacement").rmse_sequence
    assert evaluated == pytest.approx(test_error, rel=0.02)  # places of training scenes differ, and so do cells
    assert len(middles) >= 3 and max(middles) < run.scope.data.middle_high[0] + 1e-6


def test_several_motions_of_a_scene_are_answered_together(run):
    scene = scene_of()
    motions = [{1: (0, 0, -depth)} for depth in (0.01, 0.03, DEPTH)]
    together = run.predict_motions(scene, motions, frames=[-1])
    assert len(together) == 3
    for motion, answer in zip(motions, together, strict=True):
        alone = run.predict(scene, motion, frames=[-1])
        np.testing.assert_allclose(answer.position, alone.position, rtol=0, atol=2e-6)
        assert answer.frames == alone.frames and answer.scene is scene and answer.position.shape[0] == 1
    assert not np.allclose(together[0].position, together[2].position, atol=1e-3)
    with pytest.raises(ConfigError, match="scene, motion 1: there is no body 2|there is no body 2"):
        run.predict_motions(scene, [PRESS, {2: (0, 0, 1)}])


def test_a_trajectory_passes_the_same_gate_as_a_scene(run):
    """What lies outside is moved and told; what does not fit the run is refused."""
    with Dataset(run.settings.data) as data:
        truth = data["test"][0]
    answer = predicted_without_warning(run, truth)
    assert answer.scene is truth.scene and answer.expected_error is not None and answer.notes == ()
    scene = with_positions(truth.scene, truth.scene.rest_position + 2)
    there = replace(truth, scene=scene, position=truth.position + 2)
    moved = predicted_without_warning(run, there)
    assert np.array_equal(moved.position[0], there.position[0])
    # Cells lie elsewhere, so the network differs a little; Newton steps end where they are small.
    answer, moved = (run.predict(one, effort=Effort(newton_steps=10)) for one in (truth, there))
    assert rmse(moved.position - 2 - answer.position) < 0.01 * rmse(answer.position - truth.position[0])
    wide = replace(truth, scene=with_positions(truth.scene, 3 * truth.scene.rest_position), position=3 * truth.position)
    with pytest.warns(UserWarning, match="scene: the deforming bodies measure"):
        assert run.predict(wide, frames=[1], effort=Effort()).expected_error is None
    for changes, error, message in (
        (
            {"length_unit": "mm"},
            ConfigError,
            "scene has lengths in mm, but the run was trained in m: read it with Datas",
        ),
        ({"position": truth.position.astype(np.float64)}, DatasetError, "position must be float32, not float64"),
        (
            {"position": np.where(np.arange(3) == 2, np.nan, truth.position)},
            DatasetError,
            "position in frame 0 .* not fin",
        ),
        (
            {"frames": tuple(range(1, truth.num_frames + 1))},
            ConfigError,
            "has the frames 1 to .* needs all frames from 0",
        ),
        (
            {"stress": np.zeros((truth.num_frames, scene.num_elements, 1), np.float32), "stress_location": "element"},
            ConfigError,
            "has a stress at each element, but the run predicts it at each node",
        ),
        (
            {"scene": replace(truth.scene, material=np.ones((scene.num_elements, 1), np.float32))},
            ConfigError,
            "scene has a material, but the run was trained without one",
        ),
    ):
        with pytest.raises(error, match=message):
            run.predict(replace(truth, **changes))


def test_an_answer_reads_back_as_the_frames_that_it_has(run, tmp_path):
    with Dataset(run.settings.data) as data:
        truth = data["test"][0]
    answer = run.predict(truth, frames=[4, 2])
    assert answer.frames == (4, 2)
    answer.save(tmp_path / "answer.h5")
    with Dataset(tmp_path / "answer.h5") as data:
        found = data["test"][0]
    assert found.numbers == (2, 4) and np.array_equal(found.position, answer.position[::-1])
    with pytest.raises(ConfigError, match="2, 4 of a motion: a model needs all frames from 0 on; predict its scene"):
        run.predict(found)
    answer.save(tmp_path / "answer.vtkhdf", truth)
    times, meshes = read(tmp_path / "answer.vtkhdf")
    assert times == [2.0, 4.0]
    errors = np.stack([mesh.point_data["error"] for mesh in meshes])
    np.testing.assert_allclose(errors, answer.position[::-1] - truth.position[[2, 4]], rtol=0, atol=1e-7)


def test_a_prediction_that_fails_raises_and_gives_what_it_has(run, monkeypatch):
    scene = scene_of()
    whole = run.predict(scene, PRESS, num_frames=4, effort=Effort())
    advance, calls = run.model.advance, []

    def fail_in_the_end(batch, prescribed):
        position, stress = advance(batch, prescribed)
        calls.append(1)
        rows = batch.graph.node_offsets
        position[rows[-2] :] = torch.nan
        return position, stress

    monkeypatch.setattr(run.model, "advance", fail_in_the_end)
    with pytest.raises(RolloutError, match="the predicted position of node 0 in frame 3 is not finite") as error:
        run.predict(scene, PRESS, num_frames=4, effort=Effort())
    assert error.value.answer.frames == (0, 1, 2)
    np.testing.assert_allclose(error.value.answer.position, whole.position[:3], rtol=0, atol=2e-6)
    kept = run.predict(scene, PRESS, num_frames=4, effort=Effort(), throw=False)
    assert "frame 3" in kept.failure and kept.frames == (0, 1, 2)


def test_newton_steps_that_do_not_converge_warn(run):
    with pytest.warns(UserWarning, match="scene: the Newton steps have not converged: the last one has a size of"):
        answer = run.predict(scene_of(), PRESS, num_frames=3, frames=[-1], effort=Effort(newton_steps=1))
    assert answer.converged is False


def test_seconds_count_what_a_user_waits_for(run, monkeypatch):
    """The checks of the question and what is prepared for a mesh, too: here each takes half a second."""

    def slow(function):
        def slowly(*arguments, **options):
            time.sleep(0.5)
            return function(*arguments, **options)

        return slowly

    monkeypatch.setattr(run.model, "graph", slow(run.model.graph))
    monkeypatch.setattr(trained_run, "new_question", slow(trained_run.new_question))
    began = time.perf_counter()
    answer = run.predict(scene_of(), PRESS, num_frames=3)
    assert sum(answer.step_seconds) + 1.0 <= answer.seconds <= time.perf_counter() - began


@pytest.mark.parametrize(
    ("scene", "press", "options", "words"),
    [
        (scene_of(), 0.12, {}, "prescribed nodes move up to 0.12 m from their start; in training 0 m to"),
        (scene_of((0.66, 0.36, 0.03), (14, 8, 2)), DEPTH, {}, "the deforming bodies measure 0.7524 m across; in train"),
        (scene_of(cells=(7, 5, 4)), DEPTH, {}, "the mesh edges have a mean length of 0.06436 m; in training"),
        (scene_of(cells=(10, 8, 4)), DEPTH, {}, "the scene has 522 nodes; in training"),
    ],
    ids=["travel", "size", "spacing", "nodes"],
)
def test_what_lies_outside_the_training_scenes_is_told(run, scene, press, options, words):
    with pytest.warns(UserWarning) as told:
        run.predict(scene, {1: (0, 0, -press)}, name="plate.vtu", **options)
    texts = [str(warning.message) for warning in told]
    doubts = ("have not converged", "turned over")  # of the answer, as this training happens to make it
    texts = [text[: len(words) + 11] for text in texts if not any(doubt in text for doubt in doubts)]
    assert texts == [f"plate.vtu: {words}"]
    assert told[0].filename == __file__


def test_triangles_are_not_what_the_run_knows(run):
    scene = scene_of()
    with (
        pytest.warns(UserWarning, match="the elements have 3 nodes; in training 4$"),
        pytest.raises(DatasetError, match="the elements are triangles, but the model takes elastic forces"),
    ):
        run.predict(replace(scene, elements=scene.surface()), PRESS)


POSITIONS = np.repeat(scene_of().rest_position[None], 3, axis=0)


@pytest.mark.parametrize(
    ("motion", "options", "message"),
    [
        (None, {}, r"say how its prescribed nodes move: motion={BODY: \(x, y, z\)} \(--move BODY=X,Y,Z\)"),
        ({}, {}, "say how its prescribed nodes move"),
        ({2: (0, 0, 1)}, {}, "there is no body 2"),
        ({1: (0, 1)}, {}, "translation of a motion must be three numbers"),
        (PRESS, {"num_frames": 1}, "num_frames is 1; the run needs at least 2"),
        (POSITIONS[:, :5], {}, r"the motion has the shape \[3, 5, 3\], must be \[frames, 351 nodes, 3\] or"),
        (POSITIONS + np.nan, {}, "the motion is not finite in frame 0 at node 0"),
        (Motion(POSITIONS[:1]), {}, "with at least 2 frames"),
        (POSITIONS, {"num_frames": 3}, "its motion has frames already: leave out num_frames=3"),
        (
            POSITIONS,
            {"stress": np.zeros((1, 5, 1))},
            r"stress has the shape \[1, 5, 1\], but the run needs \[1, 351",
        ),
    ],
)
def test_a_motion_that_does_not_fit(run, motion, options, message):
    with pytest.raises(ConfigError, match=message) as error:
        run.predict(scene_of(), motion, **options)
    assert "\n" not in str(error.value)


def test_a_trajectory_brings_its_motion(run):
    with Dataset(run.settings.data) as data:
        truth = data["test"][0]
    for options in ({"motion": PRESS}, {"num_frames": 3}, {"stress": truth.stress[:1]}):
        with pytest.raises(ConfigError, match="has a motion, frames and a stress of its own"):
            run.predict(truth, **options)


def test_the_stress_at_the_start_is_zero_unless_given(run):
    scene = scene_of()
    answer = run.predict(scene, PRESS, num_frames=3)
    assert not answer.stress[0].any() and answer.stress[1].any()
    given = np.full((1, scene.num_nodes, 1), 5e4)
    assert np.array_equal(run.predict(scene, PRESS, num_frames=3, stress=given).stress[:1], given.astype(np.float32))


# A run with inertia and material


@pytest.fixture(scope="module")
def dynamic_run(tmp_path_factory) -> Run:
    """A small model of the toy's plates, trained for a moment; Young's modulus 1e5 to 2e5 and a Poisson ratio."""
    folder = tmp_path_factory.mktemp("dynamic")
    with DatasetWriter(folder / "toy.h5", toy.info(dynamic=True)) as writer:
        for seed, young in enumerate((1e5, 2e5)):
            truth = toy.plate(seed, dynamic=True)
            material = np.full((truth.scene.num_elements, 2), (young, 0.3), np.float32)
            writer.add("train", replace(truth, scene=replace(truth.scene, material=material)))
    settings = {"hidden": 16, "blocks": 2}
    return train(folder / "toy.h5", folder / "run", model="mgn", model_settings=settings, steps=2, batch_size=2)


def small_scene(materials=None) -> Scene:
    """As the toy's, with another place of the block."""
    plate, tets = box_between((4, 3, 1), (-0.2, -0.15, -0.02), (0.2, 0.15, 0.02))
    block, block_tets = box_between((1, 1, 1), (-0.02, -0.05, 0.021), (0.08, 0.05, 0.121))
    mesh = meshio.Mesh(np.concatenate([plate, block]), {"tetra": np.concatenate([tets, block_tets + len(plate)])})
    return read_scene(mesh, **PRESCRIBED, materials=materials).scene


def test_a_scene_with_inertia_starts_at_rest(dynamic_run):
    scene = small_scene((1.5e5, 0.3))
    answer = predicted_without_warning(dynamic_run, scene, {1: (0, 0, -0.02)})
    assert answer.given == 2
    free = ~scene.prescribed
    assert np.array_equal(answer.position[:2, free], np.repeat(scene.rest_position[None, free], 2, axis=0))
    assert not np.array_equal(answer.position[2, free], scene.rest_position[free])
    assert len(answer.position) == 1 + np.ceil(0.02 / dynamic_run.scope.usual_increment)
    # A short way takes a frame more than the two that are given.
    assert len(dynamic_run.predict(scene, {1: (0, 0, -1e-6)}).position) == 3
    with pytest.raises(ConfigError, match="num_frames is 2; the run needs at least 3"):
        dynamic_run.predict(scene, {1: (0, 0, -0.02)}, num_frames=2)


def test_a_scene_with_inertia_may_start_with_a_velocity(dynamic_run):
    scene = small_scene((1.5e5, 0.3))
    position = np.repeat(scene.rest_position[None], 4, axis=0)
    position[1, ~scene.prescribed] += np.float32(0.001)
    answer = dynamic_run.predict(scene, position)
    assert np.array_equal(answer.position[:2], position[:2])


def test_a_missing_material_names_the_columns(dynamic_run):
    wanted = r"trained with 2 \(column 0 1e\+05 to 2e\+05, column 1 0\.3 to 0\.3\): give each body its numbers"
    for materials, has in ((None, "no"), (1e5, "1")):
        with pytest.raises(ConfigError, match=f"scene has {has} material columns, but the run was {wanted}"):
            dynamic_run.predict(small_scene(materials), {1: (0, 0, -0.02)})


def test_a_material_that_the_run_has_not_seen_is_told(dynamic_run):
    with pytest.warns(UserWarning) as told:
        dynamic_run.predict(small_scene((3e5, 0.3)), {1: (0, 0, -0.02)})
    assert [str(warning.message) for warning in told] == [
        "scene: column 0 of the material is 3e+05; in training 1e+05 to 2e+05"
    ]


def test_a_material_that_the_run_does_not_take_is_refused(run):
    scene = scene_of()
    scene = replace(scene, material=np.ones((scene.num_elements, 1), np.float32))
    with pytest.raises(ConfigError, match="a material, but the run was trained without one: leave out materials="):
        run.predict(scene, PRESS)
