import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from autograd import grad

from hind4sight_min import losses, networks, training
from hind4sight_min.geometry import Camera, look_at, project, unproject
from hind4sight_min.interactions import Interactions, add_depth_noise, cells_of, smooth_depth
from hind4sight_min.networks import Sizes, windows
from hind4sight_min.training import Recipe, batch_gradient, make_batch, start_run, train, unflatten

SETTINGS = {"arena": 0.5, "cell": 0.025}
SIZES = Sizes(masks=3, width=8, embedding=6)
TINY = Recipe(steps=6, batch=5, warmup=2, seed=3, sizes=SIZES)


def camera(x=0.0):
    return Camera(16, 12, 20.0, 20.0, 7.5, 5.5, look_at([x, -0.46, 0.62], [x, 0, 0]))


def pokes_seen(count=7, seed=0, x=0.0):
    """A block on a tilted view of a table; the block is somewhere else after the poke."""
    rng = np.random.default_rng(seed)
    table = np.full((12, 16), 0.7, np.float32) + 0.01 * np.arange(12, 0, -1, dtype=np.float32)[:, None]
    depth, rgb = [], []
    for _ in range(2):
        d = np.repeat(table[None], count, axis=0)
        c = rng.integers(60, 200, (count, 12, 16, 3), dtype=np.uint8)
        for i in range(count):
            v, u = rng.integers(2, 7), rng.integers(2, 11)
            d[i, v:v + 3, u:u + 3] -= 0.05
            c[i, v:v + 3, u:u + 3, 0] = 255
        depth.append(d)
        rgb.append(c)
    cam = camera(x)
    meta = {"settings": SETTINGS, "camera": {**asdict(cam), "arena_from_camera": cam.arena_from_camera.tolist()}}
    pokes = np.column_stack([rng.uniform(-0.15, 0.15, (count, 2)), rng.uniform(-3, 3, count)]).astype(np.float32)
    starts = pokes[:, :2] - 0.05
    return Interactions(rgb[0], rgb[1], depth[0], depth[1], pokes, starts, table, cam, meta)


def random_run(recipe=TINY, seed=0):
    """A run away from its identity initialisation."""
    run = start_run(recipe, pokes_seen())
    run.vector = run.vector + 0.1 * np.random.default_rng(seed).standard_normal(run.vector.shape).astype(np.float32)
    return run


def test_gradient_of_the_full_loss_against_finite_differences(monkeypatch):  # Eq. (6)
    monkeypatch.setattr(networks, "STATE_GAIN", 0.0)  # L_sim's gradient is cut at the encoder: a test of its own below
    data, run = pokes_seen(), random_run()
    batch = make_batch(data, np.arange(3))
    for name, value in vars(batch).items():  # float64 throughout
        if value is not None and value.dtype == np.float32:
            setattr(batch, name, value.astype(float))
    vector, weights = run.vector.astype(float), dict(training.WEIGHTS, photometric=0.0)
    # cv2.remap rounds float64 positions, so the photometric term has finite differences of its own
    # in test_ops and test_losses.
    terms, gradient = batch_gradient(vector, run.layout, SIZES, batch, data.camera, weights)
    rng, step = np.random.default_rng(1), 1e-7
    for _ in range(5):
        direction = rng.standard_normal(vector.shape)
        values = []
        for sign in (1, -1):
            t, _ = batch_gradient(vector + sign * step * direction, run.layout, SIZES, batch, data.camera, weights)
            values.append(sum(weights[name] * t[name] for name in t))
        expected = (values[0] - values[1]) / (2 * step)
        assert abs(expected) > 1e-3
        np.testing.assert_allclose(gradient @ direction, expected, rtol=2e-3)
    assert all(value > 0 for value in terms.values())


def test_gradient_of_the_next_embeddings_against_finite_differences():  # L_sim
    data, run = pokes_seen(), random_run()
    batch = make_batch(data, np.arange(3))
    for name, value in vars(batch).items():
        if value is not None and value.dtype == np.float32:
            setattr(batch, name, value.astype(float))
    fixed = unflatten(run.vector.astype(float), run.layout)  # the encoder that compares

    def similarity(vector):
        prediction = training.predict_clouds(unflatten(vector, run.layout), SIZES, batch)
        return losses.embedding_loss(*training.next_embeddings(fixed, batch, prediction.points)).sum()
    vector, step, rng = run.vector.astype(float), 1e-7, np.random.default_rng(1)
    gradient = grad(similarity)(vector)
    for _ in range(3):
        direction = rng.standard_normal(vector.shape)
        expected = (similarity(vector + step * direction) - similarity(vector - step * direction)) / (2 * step)
        assert abs(expected) > 1e-2
        np.testing.assert_allclose(gradient @ direction, expected, rtol=2e-3)
    weights = dict.fromkeys(training.WEIGHTS, 0.0) | {"inverse": 1.0}
    parts = [unflatten(batch_gradient(vector, run.layout, SIZES, batch, data.camera, weights)[1], run.layout),
             unflatten(gradient / 3, run.layout)]
    np.testing.assert_allclose(*(part["mask_w"] for part in parts), rtol=1e-6)  # nothing else of L_inv reaches masks


def test_what_does_not_stand_out_is_background_that_stays(monkeypatch):
    monkeypatch.setattr(networks, "LOOK", 30)
    data, run = pokes_seen(), random_run()
    batch, sizes = make_batch(data, np.arange(3)), SIZES
    found = training.predict_clouds(run.params, sizes, batch)
    part = networks.forward_model(run.params, sizes, *(np.take_along_axis(value, batch.look[(...,) + extra], 1)
                                  for value, extra in ((batch.points, (None,)), (batch.valid, ()))), batch.pokes)
    for i, rows in enumerate(batch.look):
        assert len(set(rows)) == 30
        np.testing.assert_array_equal(found.points[i, rows], part.points[i])
        np.testing.assert_array_equal(found.masks[i, rows], part.masks[i])
        others = np.setdiff1d(np.arange(batch.points.shape[1]), rows)
        np.testing.assert_array_equal(found.points[i, others], batch.points[i, others])
        np.testing.assert_array_equal(found.masks[i, others], np.eye(3)[np.zeros(len(others), int)])
        # The block, and the table next to it, stand out.
        assert set(np.flatnonzero(batch.occupied[i])) <= set(rows)
    assert batch.occupied.any() and np.abs(part.points - batch.points[0][None, :1]).max() > 1e-3


def test_every_term_gets_its_own_arguments():
    data, run = pokes_seen(), random_run()
    data.depth_before[0, 5, 6] = data.depth_after[1, 6, 7] = 0
    batch, params = make_batch(data, np.arange(3)), run.params
    assert (batch.shared != batch.valid).any() and (batch.start_cells != batch.end_cells).any()
    terms = training.loss_terms(params, SIZES, batch, data.camera)
    prediction, flow = training.run_forward_model(params, SIZES, batch, data.camera)
    maps = losses.distance_maps(prediction.points, batch.next_points, batch.shared, batch.next_shared)
    start, end = training.run_inverse_model(params, batch)
    here, there = (networks.state_embedding(params, points, occupied) for points, occupied in
                   ((prediction.points, batch.occupied), (batch.next_points, batch.next_occupied)))
    expected = {
        "chamfer": losses.chamfer_loss(*maps),
        "distance_smoothness": losses.distance_smoothness_loss(*maps, batch.images, batch.next_images, batch.shared,
                                                               batch.next_shared),
        "photometric": losses.photometric_loss(batch.images, batch.next_images, flow, batch.shared),
        "flow_smoothness": losses.flow_smoothness_loss(flow, batch.images, batch.valid),
        "inverse": losses.heatmap_cross_entropy(start, batch.start_cells)
        + losses.heatmap_cross_entropy(end, batch.end_cells) + losses.embedding_loss(here, there),
        "sharing": losses.sharing_loss(prediction.masks.reshape(batch.images.shape[:3] + (-1,)), batch.valid)}
    assert set(terms) == set(expected) == set(training.WEIGHTS)
    for name, value in terms.items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-5, err_msg=name)


def test_every_term_reaches_the_forward_model_and_a_weight_of_none_is_refused():
    data, run = pokes_seen(), random_run()
    batch = make_batch(data, np.arange(3))
    zero = dict.fromkeys(training.WEIGHTS, 0.0)
    for name in training.WEIGHTS:
        _, gradient = batch_gradient(run.vector, run.layout, SIZES, batch, data.camera, {**zero, name: 1.0})
        parts = unflatten(gradient, run.layout)
        assert np.abs(parts["encoder_1_w"]).max() > 0, name
        assert np.abs(parts["mask_w"]).max() > 0, name
        assert (np.abs(parts["motion_1_w"]).max() > 0) == (name != "sharing"), name
        assert (np.abs(parts["heatmaps_w"]).max() > 0) == (name == "inverse")
    with pytest.raises(ValueError, match="weights"):  # nothing to learn from
        batch_gradient(run.vector, run.layout, SIZES, batch, data.camera, zero)
    with pytest.raises(ValueError, match="weights"):
        batch_gradient(run.vector, run.layout, SIZES, batch, data.camera, {**zero, "chamfre": 1.0})
    with pytest.raises(ValueError, match="weights.*above 0"):
        replace(TINY, weights=zero)


def test_an_ablated_term_is_not_computed_and_changes_nothing():
    data, run = pokes_seen(), random_run()
    batch = make_batch(data, np.arange(3))
    args = run.vector, run.layout, SIZES, batch, data.camera
    whole, gradient = batch_gradient(*args, training.WEIGHTS)
    parts = 0
    for *names, share in (("chamfer", 1e-3), ("distance_smoothness", "inverse", 1e-3),
                          ("photometric", "flow_smoothness", 1e-3), ("sharing", 1e-4)):
        terms, part = batch_gradient(*args, {name: weight * (name in names) for name, weight in
                                             training.WEIGHTS.items()})
        assert terms == {name: whole[name] for name in names}
        assert np.linalg.norm(part) > share * np.linalg.norm(gradient)
        parts = parts + part
    np.testing.assert_allclose(parts, gradient, atol=1e-5 * np.abs(gradient).max())


def test_training_lowers_the_loss_it_trains():
    data = pokes_seen()
    recipe = replace(TINY, steps=40, batch=7, mirror=False, learning_rate=2e-2)
    log = train(data, start_run(recipe, data)).log
    assert log[-1]["inverse"] < 0.8 * log[0]["inverse"]


def test_the_same_seed_gives_the_same_run_on_any_number_of_processes():
    data, recipe = pokes_seen(), replace(TINY, batch=12)  # two chunks, one larger
    alone, together = (train(data, start_run(recipe, data), jobs=jobs) for jobs in (1, 2))
    np.testing.assert_array_equal(together.vector, alone.vector)
    assert together.log == alone.log
    assert not np.array_equal(train(data, start_run(replace(recipe, seed=4), data)).vector, alone.vector)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_workers_end_with_their_parent_even_when_it_is_killed(tmp_path):
    (tmp_path / "script.py").write_text("""
import os, time
from hind4sight_min import worker_pool
if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 600).result()
""")
    with subprocess.Popen([sys.executable, str(tmp_path / "script.py")], text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.DEVNULL) as parent:
        worker = int(parent.stdout.readline())
        os.kill(worker, 0)  # it is there
        parent.kill()
    for _ in range(200):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        # an orphan in a container may have nobody to take note of its end
        if Path(f"/proc/{worker}/stat").exists() and " Z " in Path(f"/proc/{worker}/stat").read_text():
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the worker went on alone")


def test_the_gradient_of_a_batch_is_that_of_its_chunks(monkeypatch):
    data, recipe = pokes_seen(), replace(TINY, batch=7, steps=1, image_noise=0.0)  # each chunk draws its own noise
    whole = train(data, random_run(recipe))
    monkeypatch.setattr(training, "CHUNK", 3)
    chunks = train(data, random_run(recipe))
    difference = np.linalg.norm(chunks.first_moment - whole.first_moment)
    assert difference < 5e-3 * np.linalg.norm(whole.first_moment)  # rounding decides on which side of a kink it is
    for name in training.WEIGHTS:
        assert chunks.log[0][name] == pytest.approx(whole.log[0][name], rel=1e-4, abs=1e-5), name


def test_the_price_on_sharing_rises_to_its_weight(monkeypatch):
    data, recipe, seen = pokes_seen(), replace(TINY, steps=4, batch=4), []
    compute = training.batch_gradient
    monkeypatch.setattr(training, "batch_gradient", lambda *args: (seen.append(args[-1]), compute(*args))[1])
    train(data, start_run(recipe, data))
    np.testing.assert_allclose([weights["sharing"] for weights in seen],
                               recipe.weights["sharing"] * np.array([0.25, 0.5, 0.75, 1.0]))
    for weights in seen:
        assert {**weights, "sharing": recipe.weights["sharing"]} == recipe.weights


def test_the_log_is_the_mean_over_the_steps_of_an_epoch(monkeypatch):
    data, recipe, seen = pokes_seen(count=20), replace(TINY, steps=6), []  # four steps an epoch
    step = training.training_step

    def watched(interactions, run, *rest):
        before = dict(run.sums)
        step(interactions, run, *rest)
        seen.append({name: value - before.get(name, 0) for name, value in run.sums.items()})
    monkeypatch.setattr(training, "training_step", watched)
    log = train(data, start_run(recipe, data)).log
    assert [epoch["step"] for epoch in log] == [4, 6]
    for name in training.WEIGHTS:
        for epoch, steps in zip(log, (seen[:4], seen[4:])):
            assert epoch[name] == pytest.approx(np.mean([each[name] for each in steps]))


def test_a_resumed_run_is_the_same_run(tmp_path):
    data = pokes_seen(count=18)  # an epoch ends in the middle of the fourth step
    whole = train(data, start_run(TINY, data))

    class Stop(Exception):
        pass

    def stop_at_two(run):
        training.save_run(tmp_path / "run.npz", run)
        if run.step == 2:
            raise Stop
    with pytest.raises(Stop):
        train(data, start_run(TINY, data), on_step=stop_at_two)
    resumed = training.load_run(tmp_path / "run.npz")
    assert resumed.step == 2 and not resumed.log and resumed.sums
    train(data, resumed)
    np.testing.assert_array_equal(resumed.vector, whole.vector)
    assert json.loads(json.dumps(resumed.log)) == json.loads(json.dumps(whole.log))


def test_training_with_depth_noise_differs_and_repeats():
    data, noisy = pokes_seen(), replace(TINY, depth_noise=0.01)
    first, second = (train(data, start_run(noisy, data)).vector for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, train(data, start_run(TINY, data)).vector)


def test_noisy_depth_is_smoothed_in_both_frames():
    data, rows = pokes_seen(), np.arange(4)
    batch = make_batch(data, rows, depth_noise=0.01, rng=np.random.default_rng(3), whole=True)
    depth, rgb = (np.stack([getattr(data, f"{kind}_{when}")[rows] for when in ("before", "after")])
                  for kind in ("depth", "rgb"))
    noisy = add_depth_noise(depth, np.random.default_rng(3), 0.01)
    expected = unproject(smooth_depth(noisy, data.empty_depth, rgb), data.camera).reshape(2, 4, -1, 3)
    np.testing.assert_allclose(batch.points, expected[0], atol=1e-6)
    np.testing.assert_allclose(batch.next_points, expected[1], atol=1e-6)
    assert np.abs(expected - unproject(noisy, data.camera).reshape(expected.shape)).max() > 0.01


def test_image_noise_is_on_the_images_of_frame_t_and_on_nothing_else():
    data = pokes_seen()
    plain = make_batch(data, np.arange(7), whole=True)
    noisy, again = (make_batch(data, np.arange(7), whole=True, rng=np.random.default_rng(5), image_noise=0.01)
                    for _ in range(2))
    noise = noisy.images - plain.images
    assert noise.dtype == np.float32 and abs(noise.mean()) < 1e-3 and noise.std() == pytest.approx(0.01, rel=0.05)
    for name in ("next_images", "points", "shared", "before", "pokes"):
        np.testing.assert_array_equal(getattr(noisy, name), getattr(plain, name))
    np.testing.assert_array_equal(noisy.images, again.images)


@pytest.mark.parametrize("name", ["depth_noise", "image_noise"])
@pytest.mark.parametrize("bad", [-0.001, np.inf, np.nan])
def test_recipe_refuses_bad_noise(name, bad):
    with pytest.raises(ValueError, match=name):
        replace(TINY, **{name: bad})


def test_image_noise_lets_a_motion_begin():
    """Three still edges and one that moved: without noise the least common motion costs, with noise it pays."""
    count, brightness = 4000, 0.3 * np.arange(6, dtype=np.float32)[None, None, :, None]
    still, moved = np.tile(brightness, (1, 3, 1, 1)), np.tile(brightness - 0.3, (1, 1, 1, 1))  # a pixel to the right
    image = np.concatenate([still, brightness], axis=1).repeat(count, axis=0)
    next_image = np.concatenate([still, moved], axis=1).repeat(count, axis=0)
    rng, valid = np.random.default_rng(0), np.ones((count, 4, 6), bool)
    valid[..., [0, -1]] = False  # these may leave the picture

    def loss(step, noise):
        flow = np.zeros((count, 4, 6, 2), np.float32)
        flow[..., 0] = step
        return np.mean(losses.photometric_loss(image + noise, next_image, flow, valid.reshape(count, 24)))

    none, noise = 0 * image, np.float32(0.003) * rng.standard_normal(image.shape, np.float32)
    for step in (1 / 64, 1 / 16):
        assert loss(step, none) > loss(0, none) + 0.01 * step and loss(-step, none) > loss(0, none) + 0.01 * step
    assert loss(1 / 256, noise) < loss(0, noise) - 1e-3


def test_vectors_follow_the_formula_of_adam():
    run = random_run()
    start, gradients = run.vector.astype(float), np.random.default_rng(1).standard_normal((2, len(run.vector)))
    for g in gradients:
        training.optimiser_step(run, g.astype(np.float32), 0.01)
    m1, v1 = 0.1 * gradients[0], 0.001 * gradients[0] ** 2
    expected = start - 0.01 * (m1 / 0.1) / (np.sqrt(v1 / 0.001) + 1e-8)
    m2, v2 = 0.9 * m1 + 0.1 * gradients[1], 0.999 * v1 + 0.001 * gradients[1] ** 2
    expected -= 0.01 * (m2 / (1 - 0.9 ** 2)) / (np.sqrt(v2 / (1 - 0.999 ** 2)) + 1e-8)
    expected, start = unflatten(expected, run.layout), unflatten(start, run.layout)
    vectors = [name for name, shape in run.layout.items() if len(shape) == 1]
    assert len(vectors) > 10
    for name in vectors:
        np.testing.assert_allclose(run.params[name], expected[name], atol=1e-5)
        assert np.abs(run.params[name] - start[name]).min() > 1e-8


def polar_step(momentum):
    """sqrt(max(shape)) U V^T by SVD, and how far five Newton-Schulz iterations move the singular values from 1."""
    u, s, vt = np.linalg.svd(momentum, full_matrices=False)
    s = s / np.linalg.norm(momentum)
    for _ in range(5):
        s = 3.4445 * s - 4.7750 * s ** 3 + 2.0315 * s ** 5
    return np.sqrt(max(momentum.shape)) * (u * s) @ vt, s


def test_matrices_follow_the_polar_factor_of_their_momentum():
    run = random_run()
    gradients = [unflatten(g, run.layout) for g in np.random.default_rng(2).standard_normal((2, len(run.vector)))]
    middle = None
    for g in gradients:
        start, middle = middle, run.params
        training.optimiser_step(run, np.concatenate([block.ravel() for block in g.values()]).astype(np.float32), 0.01)
    matrices = [name for name, shape in run.layout.items() if len(shape) == 2]
    assert len(matrices) > 10
    for name in matrices:
        first, second = gradients[0][name], gradients[1][name]
        for before, after, momentum in ((start, middle, first),  # the mean ahead by one step, as Nesterov has it
                                        (middle, run.params, 0.9 * (0.9 * 0.1 * first + 0.1 * second) + 0.1 * second)):
            step, singular = polar_step(momentum)
            np.testing.assert_allclose(before[name] - after[name], 0.01 * step, atol=2e-5)
            assert 0.6 < np.median(singular) < 1.25
            assert np.sqrt(np.mean(step ** 2)) == pytest.approx(1, abs=0.35)


def test_orthogonalised_keeps_singular_vectors_and_evens_out_their_values():
    rng = np.random.default_rng(3)
    u, v = (np.linalg.qr(rng.standard_normal((size, 5)))[0] for size in (9, 7))
    wanted = u @ v.T
    for matrix, expected in (((u * [10, 5, 3, 2, 1]) @ v.T, wanted), ((v * [10, 5, 3, 2, 1]) @ u.T, wanted.T)):
        for scale in (1e-6, 1.0, 1e6):
            found = training.orthogonalised(np.float32(scale) * matrix.astype(np.float32))
            assert found.dtype == np.float32 and found.shape == matrix.shape
            np.testing.assert_allclose(np.linalg.svd(found)[1][:5], 1, atol=0.35)
            assert np.sum(found * expected) / np.linalg.norm(found) / np.linalg.norm(expected) > 0.97
    for least in (0, 1e-30):  # of a layer that a loss does not reach, or not any more; squares of 1e-30 are 0
        assert np.abs(training.orthogonalised(np.full((4, 3), least, np.float32))).max() < 1e-10


def test_the_step_of_a_matrix_is_that_of_torch_s_muon():
    torch = pytest.importorskip("torch")
    if not hasattr(torch.optim, "Muon"):
        pytest.skip("this torch has no Muon")
    run = random_run()
    name = "motion_2_w"
    weight = torch.nn.Parameter(torch.from_numpy(run.params[name].copy()))
    muon = torch.optim.Muon([weight], lr=0.01, momentum=0.9, nesterov=True, weight_decay=0,
                            adjust_lr_fn="match_rms_adamw")  # 0.2 of ours
    rng = np.random.default_rng(4)
    for _ in range(3):
        gradient = rng.standard_normal(len(run.vector)).astype(np.float32)
        before, ours = weight.detach().numpy().copy(), run.params[name]
        weight.grad = torch.from_numpy(unflatten(gradient, run.layout)[name].copy())
        muon.step()
        training.optimiser_step(run, gradient, 0.01)
        theirs, ours = (weight.detach().numpy() - before) / 0.2, run.params[name] - ours
        assert np.linalg.norm(ours - theirs) < 0.05 * np.linalg.norm(ours)  # it iterates in bfloat16


def test_every_epoch_shows_every_row_once():
    recipe = replace(TINY, batch=5)
    rows = np.concatenate([training.rows_of_step(recipe, 7, step)[0] for step in range(7)])  # 35 = 5 epochs of 7
    for epoch in rows.reshape(5, 7):
        np.testing.assert_array_equal(np.sort(epoch), np.arange(7))
    assert len({tuple(epoch) for epoch in rows.reshape(5, 7)}) > 1
    np.testing.assert_array_equal(np.bincount(training.rows_of_step(replace(TINY, batch=20), 7, 0)[0]) >= 2, True)


def test_a_batch_with_noise_needs_a_generator():
    with pytest.raises(ValueError, match="rng"):
        make_batch(pokes_seen(), np.arange(2), depth_noise=0.01)


@pytest.mark.parametrize("name, bad", [("batch", 2.5), ("steps", np.nan), ("association", 1.5), ("seed", -1),
                                       ("warmup", -1)])
def test_recipe_refuses_what_is_no_whole_number(name, bad):
    with pytest.raises(ValueError, match=f"{name}: expected a whole number"):
        replace(TINY, **{name: bad})


def test_half_of_the_interactions_are_shown_mirrored():
    flags = np.array([training.rows_of_step(TINY, 7, step)[1] for step in range(200)])
    assert 0.45 < flags.mean() < 0.55
    assert not any(training.rows_of_step(replace(TINY, mirror=False), 7, step)[1].any() for step in range(20))


def test_the_mirrored_batch_is_the_mirrored_world():
    data = pokes_seen()
    plain, mirrored = (make_batch(data, np.arange(3), mirror=mirror, whole=True) for mirror in (False, True))
    flip = [-1, 1, 1]
    for name in ("points", "next_points"):
        there = getattr(mirrored, name).reshape(3, 12, 16, 3)[:, :, ::-1] * flip
        np.testing.assert_allclose(there, getattr(plain, name).reshape(3, 12, 16, 3), atol=1e-6)
    np.testing.assert_array_equal(mirrored.images[:, :, ::-1], plain.images)
    for name in ("shared", "next_shared"):
        flags = getattr(plain, name).reshape(3, 12, 16)
        np.testing.assert_array_equal(getattr(mirrored, name).reshape(3, 12, 16)[:, :, ::-1], flags)
        assert not np.array_equal(flags, flags[:, :, ::-1])
    np.testing.assert_allclose(mirrored.pokes[:, :2], plain.pokes[:, :2] * [-1, 1])
    for f, sign in ((np.cos, -1), (np.sin, 1)):
        np.testing.assert_allclose(f(mirrored.pokes[:, 2]), sign * f(plain.pokes[:, 2]), atol=1e-6)
    np.testing.assert_array_equal(mirrored.start_cells, cells_of(data.starts[:3] * [-1, 1], SETTINGS))
    np.testing.assert_array_equal(mirrored.end_cells, cells_of(data.pokes[:3, :2] * [-1, 1], SETTINGS))
    # and its pictures still fit its points
    pixels = project(mirrored.points[0], data.camera).reshape(12, 16, 2)
    np.testing.assert_allclose(pixels[4, 9], [9, 4], atol=1e-3)


def test_only_the_marked_rows_are_mirrored():
    data = pokes_seen()
    plain, both = make_batch(data, np.array([2, 2])), make_batch(data, np.array([2, 2]), mirror=[False, True])
    np.testing.assert_array_equal(both.points[0], plain.points[0])
    assert not np.array_equal(both.points[1], plain.points[1])
    np.testing.assert_array_equal(data.pokes, pokes_seen().pokes)  # the data set itself is untouched


def test_batch_against_the_data():
    data = pokes_seen()
    data.depth_before[1, 3, 4] = 0
    batch = make_batch(data, np.array([1, 4]), whole=True)
    np.testing.assert_array_equal(batch.points.reshape(2, 12, 16, 3), unproject(data.depth_before[[1, 4]], data.camera))
    assert (~batch.valid).sum() == 1 and not batch.valid[0, 3 * 16 + 4] and batch.next_valid.all()
    np.testing.assert_allclose(batch.next_images, data.rgb_after[[1, 4]] / 255, atol=1e-7)
    assert batch.points.dtype == batch.images.dtype == batch.pokes.dtype == np.float32
    for i, row in enumerate((1, 4)):
        for k in range(12 * 16):
            before, after = data.depth_before[row].ravel()[k], data.depth_after[row].ravel()[k]
            empty = data.empty_depth.ravel()[k]
            stands, will_stand = 0 < before < empty - 0.008, 0 < after < empty - 0.008
            assert batch.shared[i, k] == (before > 0 and not (will_stand and not stands))
            assert batch.next_shared[i, k] == (after > 0 and not (stands and not will_stand))
    assert 0 < (~batch.shared).sum() < 30 and 0 < (~batch.next_shared).sum() < 30


def test_what_one_frame_does_not_show_has_not_changed(monkeypatch):
    monkeypatch.setattr(networks, "CHANGED_POINTS", 20)
    data = pokes_seen()
    data.depth_after[0, 3, 4] = 0
    batch = make_batch(data, np.arange(2))
    seen = batch.after[0][batch.change[0] > 0]
    assert len(seen) > 5
    assert np.linalg.norm(seen - data.camera.arena_from_camera[:3, 3], axis=1).min() > 0.3  # none is the camera itself


def test_a_window_is_cut_out_of_every_picture():
    data = pokes_seen()
    rows, mirror = np.array([1, 4, 2]), [False, True, False]
    whole, batch = make_batch(data, rows, mirror, whole=True), make_batch(data, rows, mirror)
    for i, part in enumerate(windows(whole.pokes, data.camera)):
        for name in ("points", "next_points", "valid", "next_valid", "shared", "next_shared"):
            picture = getattr(whole, name)[i]
            picture = picture.reshape(12, 16, *picture.shape[1:])
            np.testing.assert_array_equal(getattr(batch, name)[i], picture[part].reshape(48, *picture.shape[2:]))
        for name in ("images", "next_images"):
            np.testing.assert_array_equal(getattr(batch, name)[i], getattr(whole, name)[i][part])
    for name in ("before", "after", "change", "pokes", "start_cells", "end_cells"):  # these are of the whole picture
        np.testing.assert_array_equal(getattr(batch, name), getattr(whole, name))


def test_mirroring_needs_a_symmetric_camera():
    with pytest.raises(ValueError, match="mirror"):
        make_batch(pokes_seen(x=0.1), np.arange(2), mirror=True)


def test_learning_rate_schedule():
    recipe = replace(TINY, steps=100, warmup=10, learning_rate=0.5)
    rates = [training.learning_rate(recipe, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.05) and max(rates) < 0.5 and rates[50] == pytest.approx(0.25)
    assert rates[-1] < 1e-3 and (np.diff(rates[10:]) < 0).all()


def test_checkpoint_round_trip(tmp_path):
    run = train(pokes_seen(), start_run(TINY, pokes_seen()))
    training.save_run(tmp_path / "a.npz", run)
    loaded = training.load_run(tmp_path / "a.npz")
    for name in ("vector", "first_moment", "second_moment"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(run, name))
    assert loaded.recipe == run.recipe and loaded.layout == run.layout and loaded.meta == run.meta
    training.save_run(tmp_path / "b.npz", run, resumable=False)
    assert (tmp_path / "b.npz").stat().st_size < 0.6 * (tmp_path / "a.npz").stat().st_size
    np.testing.assert_array_equal(training.load_run(tmp_path / "b.npz").vector, run.vector)


def test_the_seconds_of_training_add_up_over_calls(tmp_path):
    data, run = pokes_seen(), random_run()
    run.meta["seconds"] = 1000.0
    seconds = training.train_saving(data, run, tmp_path / "run.npz")
    assert 1000 < seconds == training.load_run(tmp_path / "run.npz").meta["seconds"]


@pytest.mark.parametrize("keep", [0, 10, 500, -20])
def test_truncated_checkpoint(tmp_path, keep):
    path = tmp_path / "run.npz"
    training.save_run(path, random_run())
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="run.npz"):
        training.load_run(path)


def test_checkpoint_with_wrong_contents(tmp_path):
    run, path = random_run(), tmp_path / "run.npz"
    run.vector = run.vector[:-1]
    training.save_run(path, run)
    with pytest.raises(ValueError, match="run.npz: vector"):
        training.load_run(path)
    run = random_run()
    run.vector[5] = np.nan
    training.save_run(path, run)
    with pytest.raises(ValueError, match="run.npz: vector"):
        training.load_run(path)


def test_bad_arguments():
    data = pokes_seen()
    with pytest.raises(ValueError, match="jobs"):
        train(data, start_run(TINY, data), jobs=0)
    with pytest.raises(ValueError, match="camera"):
        train(pokes_seen(x=0.1), start_run(TINY, data))
    for name in ("steps", "batch", "learning_rate"):
        with pytest.raises(ValueError, match=name):
            Recipe(**{name: 0})


def test_a_gradient_that_is_not_finite_stops_the_run_and_leaves_it_as_it_was(monkeypatch):
    data, run = pokes_seen(), random_run()
    bad = np.zeros_like(run.vector)
    bad[3] = np.nan
    monkeypatch.setattr(training, "batch_gradient", lambda *_: (dict.fromkeys(training.WEIGHTS, 1.0), bad))
    before = [run.vector.copy(), run.first_moment.copy(), run.second_moment.copy()]
    with pytest.raises(FloatingPointError, match="step 0"):
        train(data, run)
    for old, new in zip(before, (run.vector, run.first_moment, run.second_moment)):
        np.testing.assert_array_equal(old, new)
    assert run.step == 0 and not run.sums and not run.log


def test_parameters_that_are_not_finite_are_refused():
    data, run = pokes_seen(), random_run()
    run.vector[:] = np.nan
    with pytest.raises(ValueError, match="finite"), np.errstate(invalid="ignore"):
        train(data, run)
