"""The PyTorch twin of the benchmarks computes what we compute: all terms and the gradient of their weighted sum."""
import sys
from pathlib import Path

import numpy as np
import pytest

from hind4sight_min import training
from hind4sight_min.disk.shards import load_interactions

torch = pytest.importorskip("torch", reason="PyTorch is only installed with the extra 'bench'")
ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))
import torch_twin as twin  # noqa: E402


@pytest.mark.parametrize("nearest", ["nearest_by_tree", "nearest_by_brute_force"])
def test_terms_and_gradient_of_the_twin_are_ours(nearest):
    data = load_interactions(ROOT / "data_small" / "train")[np.arange(6)]
    data.rgb_after[2], data.depth_after[2] = data.rgb_before[2], data.depth_before[2]  # a poke that changed nothing
    run = training.start_run(training.Recipe(batch=len(data)), data)
    run.vector = run.vector + 0.02 * np.random.default_rng(0).standard_normal(run.vector.shape).astype(np.float32)
    terms, gradient = training.chunk_gradient(training.unsupervised, run.vector, run.layout, run.recipe, data, 1)

    batch = training.make_batch(data, run.recipe, np.random.default_rng(1))  # the same noise on the images
    assert not batch.evidence[2][2].any() and batch.evidence[2].any()
    vector = torch.from_numpy(run.vector).requires_grad_()
    parts = vector.split([int(np.prod(shape)) for shape in run.layout.values()])
    params = {name: part.view(shape) for (name, shape), part in zip(run.layout.items(), parts)}
    found = twin.loss_terms(params, run.recipe.sizes, twin.tensors(batch), data.camera, getattr(twin, nearest))
    assert found.keys() == terms.keys() == run.recipe.weights.keys()
    for name, value in terms.items():
        assert value > 0
        np.testing.assert_allclose(found[name].item(), value, rtol=1e-4, err_msg=name)
    sum(run.recipe.weights[name] * found[name] for name in found).backward()
    difference = vector.grad.numpy() - gradient
    assert np.linalg.norm(difference) < 1e-3 * np.linalg.norm(gradient)
