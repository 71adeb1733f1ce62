"""Batches, the loss of Eq. (6), the optimisers, the loop, checkpoints."""
from dataclasses import replace

import numpy as np
import pytest
from autograd import grad
from tiny import SETTINGS, SIZES, TINY, camera, doubled, random_run, tiny_pokes

from hind4sight_min import losses, networks, training
from hind4sight_min.disk import checkpoints
from hind4sight_min.geometry import optical_flow
from hind4sight_min.interactions import cell_centres, cells_of
from hind4sight_min.ops import unflatten
from hind4sight_min.scene import crop, look, most_changed
from hind4sight_min.training import WEIGHTS, Recipe, loss_terms, make_batch, start_run, train

RNG = np.random.default_rng


# --- batches ------------------------------------------------------------------------------------------------------

def test_a_batch_holds_the_cropped_scenes_the_evidence_of_whole_pictures_and_the_cells():
    data = tiny_pokes(cam=camera(64, 48, 77.0))
    batch = make_batch(data, TINY, RNG(0))
    before, after = training.scenes_of(data)
    for whole, part, name in ((before, batch.before, "before"), (after, batch.after, "after")):
        expected = crop(whole, data.pokes, data.camera)
        for field in ("points", "valid", "occupied", "stands_out"):
            np.testing.assert_array_equal(getattr(part, field), getattr(expected, field), err_msg=f"{name} {field}")
    np.testing.assert_array_equal(batch.after.images, crop(after, data.pokes, data.camera).images)
    for found, expected in zip(batch.evidence, (*most_changed(before, after), cell_centres(SETTINGS)), strict=True):
        np.testing.assert_array_equal(found, expected)  # a crop would give the target away
    np.testing.assert_array_equal(batch.cells[:, 0], cells_of(data.starts, SETTINGS), err_msg="start and end swapped?")
    np.testing.assert_array_equal(batch.cells[:, 1], cells_of(data.pokes[:, :2], SETTINGS))
    assert (batch.cells[:, 0] != batch.cells[:, 1]).any() and batch.pokes.dtype == np.float32


def test_image_noise_is_on_the_images_of_frame_t_alone_and_every_pixels_own():
    data = tiny_pokes(count=20)
    plain, noisy, again, other = (make_batch(data, replace(TINY, image_noise=sd), RNG(seed)) for sd, seed in
                                  ((0.0, 5), (0.01, 5), (0.01, 5), (0.01, 6)))
    noise = noisy.before.images - plain.before.images
    assert noise.dtype == np.float32 and abs(noise.mean()) < 1e-3 and noise.std() == pytest.approx(0.01, rel=0.05)
    assert np.abs(noise[1:] - noise[:1]).max() > 0.01 and np.abs(noise[..., 1:] - noise[..., :1]).max() > 0.01
    np.testing.assert_array_equal(noisy.after.images, plain.after.images)
    np.testing.assert_array_equal(noisy.before.points, plain.before.points)
    np.testing.assert_array_equal(noisy.before.images, again.before.images)
    assert not np.array_equal(noisy.before.images, other.before.images)


# --- the loss -----------------------------------------------------------------------------------------------------

def looked_at(scene, pokes):
    result = np.zeros(scene.valid.shape, bool)
    for i, (rows, seen) in enumerate(zip(*look(scene, pokes))):
        result[i, rows[seen]] = True
    return result


def test_every_term_gets_its_own_arguments():
    data, run = tiny_pokes(), random_run()
    data.depth_before[0, 5, 6] = data.depth_after[1, 6, 7] = 0
    data.pokes[:4, 1] -= 0.2  # these end where no object stands
    batch, params = make_batch(data, TINY, RNG(0)), run.params
    before, after = batch.before, batch.after
    rows, seen = look(before, batch.pokes)
    assert (np.take_along_axis(before.occupied, rows, axis=1) & ~seen).any()  # L_sim leaves out what fills a row up
    valid, next_valid = losses.seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    assert (valid != before.valid).any() and (valid != next_valid).any()
    prediction = networks.predict(params, SIZES, before, batch.pokes)
    predicted = prediction.points
    flow = optical_flow(before.points, predicted, data.camera).reshape(before.images.shape[:3] + (2,))
    maps = losses.distance_maps(predicted, after.points, valid, next_valid)
    start, end = networks.inverse_model(params, *batch.evidence)
    here, there = (networks.state_embedding(params, points, scene.occupied & looked_at(scene, batch.pokes))
                   for points, scene in ((predicted, before), (after.points, after)))
    expected = {
        "chamfer": losses.chamfer_loss(*maps),
        "distance_smoothness": losses.distance_smoothness_loss(*maps, before.images, after.images, valid, next_valid),
        "photometric": losses.photometric_loss(before.images, after.images, flow, valid),
        "flow_smoothness": losses.flow_smoothness_loss(flow, before.images, before.valid),
        "inverse": losses.heatmap_cross_entropy(start, cells_of(data.starts, SETTINGS))
        + losses.heatmap_cross_entropy(end, cells_of(data.pokes[:, :2], SETTINGS))
        + losses.embedding_loss(here, there),
        "binary_masks": losses.binary_mask_loss(prediction.masks)}
    found = loss_terms(params, SIZES, batch, data.camera)
    assert set(found) == set(expected) == set(WEIGHTS)
    for name, value in found.items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-4, err_msg=name)
    assert set(loss_terms(params, SIZES, batch, data.camera, ["chamfer", "inverse"])) == {"chamfer", "inverse"}


def gradient_of(run, batch, data, weights, vector=None):
    """Terms' means and gradient of the full loss on one batch."""
    vector = run.vector if vector is None else vector

    def loss(vector):
        terms = loss_terms(unflatten(vector, run.layout), SIZES, batch, data.camera, weights)
        return losses.full_loss(terms, weights)
    return loss(vector), grad(loss)(vector)


@pytest.mark.parametrize("name", [name for name in WEIGHTS if name != "photometric"])
def test_the_gradient_of_every_term_against_finite_differences(name, monkeypatch):
    # The photometric term has finite differences of its own in test_eq3: cv2.remap rounds float64 positions.
    data, run = tiny_pokes(), random_run()
    batch, vector = doubled(make_batch(data, TINY, RNG(0))), run.vector.astype(float)
    fixed = unflatten(vector, run.layout)  # of L_sim: its gradient stops at the encoder that compares
    monkeypatch.setattr(training, "state_embedding", lambda params, *given: networks.state_embedding(fixed, *given))
    value, gradient = gradient_of(run, batch, data, {name: 1.0}, vector)
    direction, step = RNG(1).standard_normal(vector.shape), 1e-7
    values = [gradient_of(run, batch, data, {name: 1.0}, vector + sign * step * direction)[0] for sign in (1, -1)]
    expected = (values[0] - values[1]) / (2 * step)
    assert abs(expected) > 1e-6 and value > 0
    np.testing.assert_allclose(gradient @ direction, expected, rtol=2e-3)


@pytest.mark.parametrize("name", WEIGHTS)
def test_every_term_reaches_masks_motions_and_encoder_in_float32(name):
    data, run = tiny_pokes(), random_run()
    parts = unflatten(gradient_of(run, make_batch(data, TINY, RNG(0)), data, {name: 1.0})[1], run.layout)
    for reached in ("encoder_1_w", "mask_w", *["motion_1_w"] * (name != "binary_masks")):
        assert np.abs(parts[reached]).max() > 0 and parts[reached].dtype == np.float32, reached


def test_the_price_on_half_masks_grows_in_proportion_to_the_steps_and_nothing_else_does():
    seen, run = [], random_run()

    def objective(params, recipe, interactions, rng):
        seen.append(recipe.weights)
        return training.unsupervised(params, recipe, interactions, rng)
    for step in (0, 3, 5):
        run.step = step
        training.training_step(tiny_pokes(), run, objective)
        weights = {**WEIGHTS, "binary_masks": pytest.approx(WEIGHTS["binary_masks"] * (step + 1) / TINY.steps)}
        assert seen[-1] == weights, f"step {step}"


# --- optimisers ---------------------------------------------------------------------------------------------------

def two_steps(optimiser, gradients):
    """The steps that an optimiser takes for two gradients in turn."""
    run, steps = random_run(), []
    for gradient in gradients:
        run.step += 1
        steps.append(optimiser(run, gradient.astype(np.float32), 0.01))
    return run, steps


def gradients_of_two_steps():
    return RNG(1).standard_normal((2, len(random_run().vector)))


def test_adam_follows_its_formula():
    g1, g2 = gradients_of_two_steps()
    _, (first, second) = two_steps(training.adam, (g1, g2))
    np.testing.assert_allclose(first, 0.01 * g1 / (np.abs(g1) + 1e-8), rtol=1e-4)
    m, v = 0.9 * 0.1 * g1 + 0.1 * g2, 0.999 * 0.001 * g1 ** 2 + 0.001 * g2 ** 2
    np.testing.assert_allclose(second, 0.01 * m / 0.19 / (np.sqrt(v / (1 - 0.999 ** 2)) + 1e-8), rtol=1e-3, atol=1e-8)


def test_muon_is_adam_for_vectors_and_the_polar_factor_of_the_momentum_for_matrices():
    gradients = gradients_of_two_steps()
    run, (_, adam) = two_steps(training.adam, gradients)
    _, (_, muon) = two_steps(training.muon, gradients)
    g1, g2, adam, muon = (unflatten(each, run.layout) for each in (*gradients, adam, muon))
    for name, shape in run.layout.items():
        if len(shape) == 1:
            np.testing.assert_array_equal(muon[name], adam[name])
            continue
        momentum = 0.9 * (0.9 * 0.1 * g1[name] + 0.1 * g2[name]) + 0.1 * g2[name]  # ahead by one step, as Nesterov's
        u, s, vt = np.linalg.svd(momentum, full_matrices=False)
        s = s / np.linalg.norm(momentum)
        for _ in range(5):
            s = 3.4445 * s - 4.7750 * s ** 3 + 2.0315 * s ** 5
        np.testing.assert_allclose(muon[name], 0.01 * np.sqrt(max(shape)) * (u * s) @ vt, atol=2e-5, err_msg=name)
        assert 0.6 < np.median(s) < 1.25


@pytest.mark.parametrize("entry", [0, 1e-30])  # the squares of 1e-30 are 0
def test_a_layer_that_no_loss_reaches_stays(entry):
    assert np.abs(training.orthogonalised(np.full((4, 3), entry, np.float32))).max() < 1e-10


def test_the_learning_rate_warms_up_and_falls_as_a_cosine():
    recipe = replace(TINY, steps=100, warmup=10, learning_rate=0.5)
    rates = [training.learning_rate(recipe, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.05) and max(rates) < 0.5 and rates[50] == pytest.approx(0.25)
    assert rates[-1] < 1e-3 and (np.diff(rates[10:]) < 0).all()
    run = random_run(replace(TINY, optimiser="adam"))
    before = run.vector
    training.training_step(tiny_pokes(), run)
    first = np.abs(run.vector - before).max()  # of Adam: the rate itself
    assert first == pytest.approx(training.learning_rate(run.recipe, 0), rel=1e-3), "another step's rate"


# --- the loop -----------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("optimiser", ["muon", "adam"])
def test_training_lowers_the_loss_it_trains(optimiser):
    recipe, seen = replace(TINY, steps=40, batch=7, learning_rate=0.02, optimiser=optimiser), []
    train(tiny_pokes(), start_run(recipe, tiny_pokes()), on_step=lambda run, terms: seen.append(terms["inverse"]))
    assert len(seen) == 40 and np.mean(seen[-5:]) < 0.8 * np.mean(seen[:5])


def test_every_epoch_shows_every_row_once_and_order_and_first_weights_are_the_seeds_own():
    recipe = replace(TINY, batch=5)
    rows = np.concatenate([training.rows_of_step(recipe, 7, step) for step in range(7)]).reshape(5, 7)  # 5 epochs
    np.testing.assert_array_equal(np.sort(rows, axis=1), np.tile(np.arange(7), (5, 1)))
    assert len({tuple(epoch) for epoch in rows}) > 1
    other = [training.rows_of_step(replace(recipe, seed=4), 7, step) for step in range(7)]
    assert not np.array_equal(np.concatenate(other), rows.ravel()), "the order of the pokes ignores the seed"
    first, same, other = (start_run(replace(TINY, seed=seed), tiny_pokes()).vector for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other), "the initialisation ignores the seed"


def test_noise_is_drawn_anew_for_every_chunk_step_and_seed(monkeypatch):
    monkeypatch.setattr(training, "CHUNK", 3)
    data, drawn = tiny_pokes(), []

    def watched(params, recipe, interactions, rng):
        drawn.append(float(rng.standard_normal()))
        return training.unsupervised(params, recipe, interactions, rng)
    for seed in (3, 4):
        train(data, start_run(replace(TINY, steps=2, batch=6, seed=seed), data), watched)
    assert len(drawn) == len(set(drawn)) == 8, "the same noise more than once"
    train(data, start_run(replace(TINY, steps=2, batch=6), data), watched)
    assert drawn[8:] == drawn[:4]


def test_the_gradient_of_a_batch_is_that_of_its_chunks_and_a_map_may_spread_them(monkeypatch):
    data, recipe = tiny_pokes(), replace(TINY, batch=7, steps=1, image_noise=0.0)  # each chunk draws its own noise
    whole, calls = random_run(recipe), []
    terms = training.training_step(data, whole)
    monkeypatch.setattr(training, "CHUNK", 3)

    def spread(function, *arguments):
        calls.extend(zip(*arguments))
        return [function(*call) for call in zip(*arguments)]
    chunks = random_run(recipe)
    parts = training.training_step(data, chunks, map=spread)
    assert [len(call[4]) for call in calls] == [3, 3, 1]
    difference = np.linalg.norm(chunks.first_moment - whole.first_moment)
    assert difference < 5e-3 * np.linalg.norm(whole.first_moment)  # rounding decides on which side of a kink it is
    for name in set(parts) - {"photometric"}:  # its value, not its gradient, depends on how much a crop holds
        assert parts[name] == pytest.approx(terms[name], rel=1e-3, abs=1e-5), name


def test_a_gradient_that_is_not_finite_stops_the_run_and_leaves_it_as_it_was():
    data, run = tiny_pokes(), random_run(replace(TINY, weights={"chamfer": 1.0}))

    def broken(params, recipe, interactions, rng):
        return {"chamfer": np.ones(len(interactions)) * (params["mask_b"] * np.inf).sum()}
    before = run.vector.copy()
    with pytest.raises(FloatingPointError, match="step 0"), np.errstate(invalid="ignore"):
        train(data, run, broken)
    np.testing.assert_array_equal(run.vector, before)
    assert run.step == 0 and not run.first_moment.any() and not run.second_moment.any()


# --- checkpoints --------------------------------------------------------------------------------------------------

def test_a_checkpoint_comes_back_as_it_was(tmp_path):
    run = train(tiny_pokes(), start_run(TINY, tiny_pokes()))
    for name, resumable in (("a.npz", True), ("b.npz", False)):
        checkpoints.save_run(tmp_path / name, run, resumable)
        loaded = checkpoints.load_run(tmp_path / name)
        for field in ("recipe", "layout", "step", "meta"):
            assert getattr(loaded, field) == getattr(run, field), field
        for field in ("vector", "first_moment", "second_moment"):
            moments = getattr(run, field)
            expected = moments if resumable or field == "vector" else 0 * moments
            np.testing.assert_array_equal(getattr(loaded, field), expected, err_msg=field)
    assert (tmp_path / "b.npz").stat().st_size < 0.6 * (tmp_path / "a.npz").stat().st_size


@pytest.mark.parametrize("spoil, said", [
    (lambda run: setattr(run, "vector", run.vector[:-1]), "vector: expected"),
    (lambda run: run.vector.__setitem__(5, np.nan), "vector: expected"),
    (lambda run: run.layout.update(motion_2_w=(10, 11)), "motion_2_w: .*10, 10.*10, 11"),
    (lambda run: run.layout.pop("cell_3_b"), "cell_3_b")])
def test_a_checkpoint_that_does_not_fit_names_what_differs(tmp_path, spoil, said):
    run, path = random_run(), tmp_path / "run.npz"
    spoil(run)
    checkpoints.save_run(path, run)
    with pytest.raises(ValueError, match=f"run.npz: {said}"):
        checkpoints.load_run(path)


@pytest.mark.parametrize("name, bad, said", [
    ("steps", 0, "whole number >= 1"), ("steps", np.nan, "whole number"), ("batch", 2.5, "whole number"),
    ("warmup", -1, "whole number >= 0"), ("seed", -1, "whole number >= 0"), ("learning_rate", 0.0, "> 0"),
    ("learning_rate", np.inf, "finite"), ("image_noise", -0.001, ">= 0"), ("image_noise", np.nan, ">= 0"),
    ("optimiser", "sgd", "adam, muon"), ("weights", {"chamfer": -1.0}, ">= 0"), ("weights", {}, "at least one"),
    ("weights", dict.fromkeys(WEIGHTS, 0.0), "at least one above 0")])
def test_a_recipe_refuses(name, bad, said):
    with pytest.raises(ValueError, match=f"{name}: .*expected .*{said}"):
        Recipe(**{name: bad})


def test_no_pokes_at_all_are_refused():
    with pytest.raises(ValueError, match="data: pokes: expected .*>= 1, got 0"):
        train(tiny_pokes()[:0], start_run(TINY, tiny_pokes()))
