"""Bands: the quantile of scores, what a calibrated run says, and when it says nothing."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
import toy
from scipy.stats import betabinom

import ast_sim
from ast_sim.inference.calibrate import quantile
from ast_sim.inference.effort import Effort
from ast_sim.inference.promises.calibration import Calibration
from ast_sim.inference.promises.kept_errors import KeptErrors
from ast_sim.inference.quantities.band import VALUES, Comparison, compared
from ast_sim.runs import checkpoint
from ast_sim.support.errors import CheckpointError, ConfigError


def test_the_quantile_is_the_score_of_the_rank():
    assert quantile(list(range(1, 20))) == 19  # ceil(20 * 0.95) = 19
    assert quantile(list(range(100, 0, -1))) == 96  # ceil(101 * 0.95) = 96
    assert quantile([1.0] * 19 + [np.inf]) == np.inf


def test_fresh_scores_lie_within_the_quantile_as_often_as_is_promised():
    """The number of m fresh scores at most q is beta-binomial: by the rank 96 of 100, with 96 and 5."""
    rng = np.random.default_rng(5)
    held = np.array([(rng.lognormal(size=300) <= quantile(rng.lognormal(size=100).tolist())).sum() for _ in range(400)])
    expected = betabinom(300, 96, 5)
    assert held.mean() == pytest.approx(expected.mean(), abs=4 * expected.std() / 20)
    assert held.std() == pytest.approx(expected.std(), rel=0.2)


def test_a_score_is_the_largest_error_over_the_scale():
    comparison = Comparison(np.array([0.0, 0.01]), np.array([0.0, 0.02]), np.array([0.001, 0.005]))
    assert comparison.score(0.01) == pytest.approx(0.25) and comparison.score(0.001) == pytest.approx(1)
    assert Comparison(np.zeros(2), np.zeros(2), np.zeros(2)).score(0.0) == 0


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A run that has learned for a moment, calibrated on the test plates that lie within the training; its dataset."""
    folder = tmp_path_factory.mktemp("calibrated")
    data = toy.write(folder / "toy.h5", (40, 1, 24))
    run = ast_sim.train(
        data, folder / "run", steps=2, batch_size=2, model="mgn", model_settings={"hidden": 8, "blocks": 1}
    )
    result = ast_sim.calibrate(run, data, "test")
    return run, data, result


def by_hand(answer, truth):
    """[S - 1, 2] three times: of displacement and largest stress the sizes in the answer, in truth, and the errors."""
    free = ~truth.scene.prescribed
    moved = [(one.position - truth.scene.rest_position)[1:, free].astype(np.float64) for one in (answer, truth)]
    highest = [one.stress[1:, truth.scene.deforming_nodes].max(axis=(1, 2)) for one in (answer, truth)]
    columns = [(np.sqrt(np.square(a).sum(axis=2).mean(axis=1)), b) for a, b in zip(moved, highest, strict=True)]
    errors = np.linalg.norm(moved[0] - moved[1], axis=2).max(axis=1), np.abs(highest[0] - highest[1])
    return [np.stack(each, axis=1) for each in (*columns, errors)]


def test_the_calibration_is_the_score_of_the_rank(calibrated):
    run, data, result = calibrated
    with ast_sim.Dataset(data) as dataset:
        trajectories = [dataset["test"][index] for index in range(24)]
    pairs = [(answer, truth) for truth in trajectories if not (answer := run.predict(truth)).notes]
    answers, truths = zip(*pairs, strict=True)
    assert 19 <= len(pairs) == result.scenes <= 24 and set(result.quantiles) == {"displacement", "stress"}
    sizes, true_sizes, errors = (np.array(each) for each in zip(*(by_hand(a, t) for a, t in pairs), strict=True))
    typical = np.sqrt(np.square(true_sizes).mean(axis=(0, 1)))  # of displacement and stress
    assert list(result.typical.values()) == pytest.approx(typical, rel=1e-5)
    widths = (errors / (sizes + typical)).max(axis=(0, 1))  # of up to 38 scores the last
    assert [one for (one,) in result.quantiles.values()] == pytest.approx(widths, rel=1e-4)
    for column, quantity in enumerate(("displacement", "stress")):
        band = answers[0].band(quantity)
        assert band[1:] == pytest.approx(widths[column] * (sizes[0] + typical)[:, column], rel=1e-4)
        assert band[0] == 0  # the frame is given
    assert f"band: with 95 % all free nodes lie within {answers[0].band().max():.3g} m" in answers[0].how_far[-1]
    assert answers[0].band("reaction") is None  # the law of these plates is not known
    assert set(compared(answers[0], truths[0])) == {"displacement", "stress"}


def test_a_run_keeps_its_calibration_and_so_does_its_file(calibrated, tmp_path):
    run, _, result = calibrated
    run.save(tmp_path / "at_once.ast")
    assert ast_sim.Run(tmp_path / "at_once.ast").calibration == result
    assert ast_sim.Run(run.path).calibration == result
    ast_sim.Run(run.path).save(tmp_path / "toy.ast")
    assert ast_sim.Run(tmp_path / "toy.ast").calibration == result


def test_a_file_is_calibrated_by_saving_it_once_more_and_keeps_its_licence(calibrated, tmp_path):
    run, data, result = calibrated
    ast_sim.Run(run.path).save(tmp_path / "toy.ast", "for tests only")
    opened = ast_sim.Run(tmp_path / "toy.ast")
    before = (tmp_path / "toy.ast").read_bytes()
    opened.folder.keep_calibration({**result.to_json(), "scenes": 77})
    opened.save(tmp_path / "again.ast")
    assert (tmp_path / "toy.ast").read_bytes() == before
    again = ast_sim.Run(tmp_path / "again.ast")
    assert again.calibration == replace(result, scenes=77) and again.folder.licence == "for tests only"
    with pytest.warns(UserWarning, match="toy.ast is a file, which is not changed: Run.save writes one with the band"):
        assert ast_sim.calibrate(opened, data, "test") == result


def test_the_calibration_of_another_version_does_not_count(calibrated, tmp_path):
    run, _, result = calibrated
    run.folder.keep_calibration({"quantile": 0.4, "scenes": 20})
    try:
        with pytest.warns(UserWarning, match="was calibrated by another version of ast_sim, which does not count"):
            assert ast_sim.Run(run.path).calibration is None
    finally:
        run.folder.keep_calibration(result.to_json())


def test_a_calibration_is_not_kept_beside_a_checkpoint_that_was_marked_since(calibrated, tmp_path):
    """It would promise the errors of other weights."""
    run, _, result = calibrated
    opened = ast_sim.Run(shutil.copytree(run.path, tmp_path / "run"))
    before = checkpoint.read_best(opened.path)
    newer = checkpoint.at_step(opened.path, before.step + 1)
    shutil.copytree(checkpoint.at_step(opened.path, before.step), newer)
    checkpoint.mark_best(opened.path, before.step + 1, before.error / 2)
    with pytest.raises(CheckpointError, match=f"at step {before.step}, and step {before.step + 1} is better"):
        opened.folder.keep_calibration(result.to_json())
    assert checkpoint.read_best(opened.path).answers == {}


def test_no_band_where_nothing_is_known(calibrated):
    run, data, result = calibrated
    with ast_sim.Dataset(data) as dataset:
        trajectories = [dataset["test"][index] for index in range(24)]
    answer = next(answer for truth in trajectories if not (answer := run.predict(truth)).notes)
    assert set(result.bands(answer, run.effort, ())) == {"displacement", "stress"}
    assert not result.bands(answer, run.effort, ("it is large",))  # which is told already
    for other, words in (
        (
            replace(result, efforts=(Effort(3),)),
            r"no band: the run was calibrated with 1 effort \(run.calibration.efforts\), but not with 0 corrections",
        ),
        (
            replace(result, quantiles={"displacement": (np.inf,)}),
            "no band: too many calibration scenes failed with 0 corrections",
        ),
        (replace(result, spacing=(1.0, 2.0)), "no band: the mesh edges are .* in the calibration scenes 1 to 2"),
        (
            replace(result, farthest=(0.0, 1e-4)),
            "no band: prescribed nodes move up to .* from their places at rest, in the calibration scenes 0.0001 at mo",
        ),
    ):
        with pytest.warns(UserWarning, match=words):
            assert not other.bands(answer, run.effort, ())


def test_a_band_of_shallow_frames_is_none_of_deep_ones(calibrated):
    """Ranges of the training include both; the calibration scenes were stored in shallow frames alone."""
    run, data, result = calibrated
    with ast_sim.Dataset(data) as dataset:
        truths = [dataset["test"][index] for index in range(24)]
    motions = [np.linalg.norm((t.position - t.scene.rest_position)[:, t.scene.prescribed], axis=2) for t in truths]
    known = [number for number, truth in enumerate(truths) if not run.predict(truth).notes]
    depths = [motions[number].max() for number in known]
    assert result.farthest == pytest.approx((min(depths), max(depths)), rel=1e-6)
    number = known[int(np.argmax(depths))]
    by_frame = motions[number][1:].max(axis=1)
    shallow, deep = (1 + int(frame) for frame in (by_frame.argmin(), by_frame.argmax()))
    assert by_frame.max() > 1.2 * by_frame.min()
    run.calibration = replace(result, farthest=(0.0, by_frame.min()), familiarity=None)
    try:
        assert run.predict(truths[number], frames=[shallow]).band() is not None
        with pytest.warns(UserWarning, match="no band: prescribed nodes move up to"):
            assert run.predict(truths[number], frames=[deep]).band() is None
        kept = KeptErrors((Effort(),), {"displacement": ((0.4,) * 20,)})
        run.calibration = replace(run.calibration, kept=kept)
        with pytest.warns(UserWarning, match="no error is promised: prescribed nodes move up to"):
            assert "promise" not in run.predict(truths[number], frames=[deep], error=0.5).source
    finally:
        run.calibration = result


def test_figures_and_files_of_an_answer_hold_its_bands(calibrated, tmp_path):
    """They are read without the object that would say how far to trust it."""
    run, data, _ = calibrated
    with ast_sim.Dataset(data) as dataset:
        truth = next(t for t in (dataset["test"][i] for i in range(24)) if not run.predict(t).notes)
    answer = run.predict(truth, frames=[2, 0, 1])
    bands = {"displacement_band": answer.band(), "largest_stress_band": answer.band("stress")}
    assert all(band[1] == 0 and band[0] > 0 and band[2] > 0 and band[0] != band[2] for band in bands.values())
    for row, figures in enumerate(answer.figures()):
        assert {name: figures[name] for name in bands} == {name: band[row] for name, band in bands.items()}
    answer.save(tmp_path / "answer.csv")
    with (tmp_path / "answer.csv").open() as file:
        for row, line in enumerate(csv.DictReader(file)):
            assert {name: float(line[name]) for name in bands} == {name: band[row] for name, band in bands.items()}
            assert "notes" not in line
    answer.save(tmp_path / "answer.h5")
    with ast_sim.Dataset(tmp_path / "answer.h5") as kept:
        saved = kept["test"][0]
    for name, band in bands.items():
        assert saved.attributes[name] == pytest.approx(band[[1, 2, 0]].tolist())  # in ascending order of the frames
    with pytest.warns(UserWarning, match="prescribed nodes move"):
        run.predict(truth.scene, {1: (0, 0, -1)}, num_frames=3).save(tmp_path / "far.csv")
    with (tmp_path / "far.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 3 and all("prescribed nodes move up to 1 m" in line["notes"] for line in lines)
    assert not any(name in lines[0] for name in bands)


def test_what_cannot_be_calibrated_is_refused(calibrated):
    run, data, _ = calibrated
    with pytest.raises(ConfigError, match="have trained or chosen the run"):
        ast_sim.calibrate(run, data, "train")
    with pytest.raises(
        ConfigError, match=r"there are 0: make more with generate\(..., calibration=N\) \(--calibration N\)"
    ):
        ast_sim.calibrate(run, data)
    assert run.calibration == calibrated[2]  # what was known stays known
    assert Calibration.from_json(calibrated[2].to_json()) == calibrated[2]


def test_the_kept_errors_are_the_errors_of_answers_to_each_effort(calibrated):
    """The errors of an effort, worked out by hand, scene by scene."""
    run, data, result = calibrated
    assert result.kept.efforts == (Effort(),) and set(result.kept.errors) == {"displacement", "stress"}
    expected = []
    with ast_sim.Dataset(data) as dataset:
        for truth in (dataset["test"][index] for index in range(24)):
            moved = (truth.position - truth.position[0])[:, ~truth.scene.prescribed].astype(np.float64)
            frame = int(np.square(moved).sum(axis=(1, 2)).argmax())
            answer = run.predict(truth, frames=frame, effort=Effort())
            if not answer.notes:
                wrong = (answer.position[0] - truth.position[frame])[~truth.scene.prescribed]
                expected.append(np.linalg.norm(wrong) / np.linalg.norm(moved[frame]))
    assert result.kept.errors["displacement"][0] == pytest.approx(expected, rel=1e-4)
    assert "displacement: error at the deepest frame in 90 % of scenes: " in result.text


def test_a_prediction_that_asks_for_an_error_makes_the_chosen_effort(calibrated):
    run, data, result = calibrated
    with ast_sim.Dataset(data) as dataset:
        truth = next(t for t in (dataset["test"][i] for i in range(24)) if not run.predict(t).notes)
    run.calibration = None
    try:
        with pytest.raises(ConfigError, match="before it is calibrated: ast-sim calibrate RUN DATA"):
            run.predict(truth, error=0.5)
        errors = {"displacement": ((0.4,) * 20,), "reaction": ((0.01,) * 20,)}
        run.calibration = replace(result, kept=KeptErrors((Effort(),), errors))
        for more in ({"effort": Effort()}, {"ms": 50}):
            with pytest.raises(ConfigError, match="an effort, an error and a time each choose"):
                run.predict(truth, error=0.5, **more)
        answer = run.predict(truth, error={"displacement": 0.5, "reaction": 0.02})
        (same,) = run.predict_scenes([(truth.scene, truth.position)], error=0.5)
        run.calibration = replace(run.calibration, spacing=(1.0, 2.0))
        with pytest.warns(UserWarning, match="no error is promised: the mesh edges are"):
            unlike = run.predict(truth, error=0.5)
        assert "promise" not in unlike.source and not any("cheapest" in line for line in unlike.how_far)
    finally:
        run.calibration = result
    kept = "0 corrections, the cheapest that keeps 50 % of the displacement"
    where = "at the deepest frame in 90 % of scenes like it"
    assert answer.how_far[0] == f"effort: {kept} and 2 % of the reaction {where}"
    assert same.how_far[0] == f"effort: {kept} {where}"
    assert np.array_equal(answer.position, run.predict(truth, effort=Effort()).position)


def test_no_error_is_promised_of_a_smaller_displacement_than_any_in_training(calibrated):
    """An error is a share of the displacement, and of a small one it may be larger."""
    run, data, result = calibrated
    with ast_sim.Dataset(data) as dataset:
        truth = next(t for t in (dataset["test"][i] for i in range(24)) if not run.predict(t).notes)
    least = result.farthest[0]
    kept = KeptErrors((Effort(),), {"displacement": ((0.4,) * 20,)})
    run.calibration = replace(result, kept=kept, familiarity=None)
    try:
        assert "promise" in run.predict(truth, error=0.5).source
        for depth, frames in ((0.9, None), (1.0, [1])):
            motion = {1: (0, 0, -depth * least)}
            with pytest.warns(
                UserWarning, match="no error is promised: prescribed nodes move up to .* in the wanted fra"
            ):
                answer = run.predict(truth.scene, motion, num_frames=5, frames=frames, error=0.5)
            assert "promise" not in answer.source and answer.source["effort"] == "0 corrections"
        shallow = run.predict(truth.scene, {1: (0, 0, -0.96 * least)}, num_frames=5, error=0.5)
        assert "promise" in shallow.source  # within the leeway
    finally:
        run.calibration = result


def test_a_quantity_that_is_added_gets_a_band(calibrated, tmp_path, monkeypatch):
    """docs/how-to/new-dial-or-band.md: one function is enough."""
    run, data, result = calibrated
    copy = ast_sim.Run(shutil.copytree(run.path, tmp_path / "run"))
    monkeypatch.setitem(VALUES, "height", lambda answer: answer.position[:, :, 2:].max(axis=1, keepdims=True))
    again = ast_sim.calibrate(copy, data, "test")
    assert set(again.quantiles) == {*result.quantiles, "height"}
    with ast_sim.Dataset(data) as dataset:
        answer = next(answer for truth in dataset["test"] if not (answer := copy.predict(truth)).notes)
    highest = np.abs(answer.position[1:, :, 2].max(axis=1).astype(float))
    width = again.quantiles["height"][again.efforts.index(copy.effort)]
    assert answer.band("height")[1:] == pytest.approx(width * (highest + again.typical["height"]))
