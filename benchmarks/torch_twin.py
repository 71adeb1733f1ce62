"""The same model and losses in PyTorch (CPU): what most readers would write instead.

Only for the benchmarks; tests/test_twin.py holds it to our losses and gradients. Everything is written the way
PyTorch users do (autograd, batched kernels, `grid_sample`); only Chamfer has two forms, of which the faster counts:
brute force on all pairs, and SciPy's KD-tree for the indices.
"""
import math

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree

from hind4sight_min import networks
from hind4sight_min.networks import wall_map
from hind4sight_min.losses import EDGE_SHARPNESS, seen_in_both
from hind4sight_min.ops import LEAK
from hind4sight_min.scene import look


def tensors(batch):
    """A training.Batch as a dict of tensors, with the points that the model looks at."""
    before, after = batch.before, batch.after
    rows, seen = look(before, batch.pokes)
    arrays = {**vars(before), **{f"next_{name}": value for name, value in vars(after).items()}}
    arrays["shared"], arrays["next_shared"] = seen_in_both(before.valid, after.valid, before.occupied, after.occupied)
    next_rows, next_seen = look(after, batch.pokes)
    arrays.update(rows=rows, seen=seen, next_rows=next_rows, next_seen=next_seen, pokes=batch.pokes,
                  walls=wall_map(batch.pokes, before.arena))
    arrays.update(zip(("changed", "next_changed", "change", "centres"), batch.evidence))
    arrays["start"], arrays["end"] = batch.cells.T
    return {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}


# --- the network ----------------------------------------------------------------------------------------------

def activation(x):
    return F.leaky_relu(x, float(LEAK))


def fourier(values, wavelengths):
    phase = (values[..., None] * (2 * math.pi / torch.tensor(wavelengths, dtype=values.dtype))).flatten(-2)
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


def position_features(points, unit, wavelengths):
    return torch.cat([points / unit, torch.tanh(points[..., 2:] / 0.01), fourier(points[..., :2], wavelengths)], dim=-1)


def poke_features(local):
    return position_features(local, 0.1, (0.4, 0.2, 0.1, 0.05))


def height_map(local, valid):
    across, along = ((1 - (local[..., axis, None] / networks.MAP_CELL - torch.from_numpy(centres)).abs()).clamp(min=0)
                     for axis, centres in ((1, networks.MAP_Y), (0, networks.MAP_X)))
    across, along = across * valid[..., None], along.transpose(1, 2)
    return (along @ (across * local[..., 2:].clamp(min=0)) / (along @ across + 0.2) / 0.03).flatten(1)


def poke_axes(pokes):
    c, s, zero = pokes[:, 2].cos(), pokes[:, 2].sin(), torch.zeros_like(pokes[:, 2])
    axes = torch.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], dim=-1).reshape(-1, 3, 3)
    return axes, torch.stack([pokes[:, 0], pokes[:, 1], zero], dim=-1)


def first_met(local, valid):
    x, y, z = local.unbind(-1)
    central = (1 - (y / networks.FINGER) ** 2).clamp(min=0).sqrt()
    depth = networks.FINGER * central - x
    met = valid & (z > networks.ABOVE) & (central > 0) & (x > -0.16) & (depth > 0)
    depth = depth * met
    weights = met * central * torch.exp((depth - depth.amax(dim=1, keepdim=True)) / 0.004)
    return weights / (weights.sum(dim=1, keepdim=True) + 1e-6)


def max_over_points(x, valid):
    """Over the valid points; 0 where there is none, not -inf."""
    return x.masked_fill(~valid[..., None], -math.inf).amax(dim=1).masked_fill(~valid.any(dim=1, keepdim=True), 0)


def linear(p, name, x):
    return x @ p[name + "_w"] + p[name + "_b"]


def encode(p, points):
    x = activation(linear(p, "encoder_1", position_features(points, 0.25, (0.8, 0.4, 0.2, 0.1))))
    return activation(linear(p, "encoder_2", x))


def state_embedding(p, points, occupied):
    fixed = {name: value.detach() for name, value in p.items()}  # its gradient goes to the points alone
    return networks.STATE_GAIN * (encode(fixed, points) * occupied[..., None]).sum(dim=1)


def so3_exp(w):
    square = (w * w).sum(dim=-1)
    small = square < 1e-4
    t = torch.where(small, torch.ones_like(square), square).sqrt()
    a = torch.where(small, 1 - square / 6 + square ** 2 / 120, t.sin() / t)
    b = torch.where(small, 0.5 - square / 24 + square ** 2 / 720, 2 * (t / 2).sin() ** 2 / t ** 2)
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*w.shape[:-1], 3, 3)
    return torch.eye(3, dtype=w.dtype) + a[..., None, None] * cross + b[..., None, None] * (cross @ cross)


def forward_model(p, sizes, points, valid, pokes, walls):
    """-> predicted points, masks (B, M, K); networks.forward_model."""
    axes, origins = poke_axes(pokes)
    local = (points - origins[:, None]) @ axes
    met = first_met(local, valid)[:, None]
    shape = activation(linear(p, "shape_2", activation(linear(p, "shape_1", height_map(local, valid) + walls))))

    def context(h):
        return torch.cat([max_over_points(h, valid), (met @ h)[:, 0], shape], dim=1)

    h = activation(linear(p, "trunk_0", torch.cat([poke_features(local), encode(p, points)], dim=2)))
    for i in range(1, sizes.rounds + 1):
        h = h + activation(h @ p[f"trunk_{i}_w"] + linear(p, f"context_{i}", context(h))[:, None])
    movers = networks.MASK_BOUND * torch.tanh(linear(p, "mask", h) / networks.MASK_BOUND)
    every = torch.softmax(F.pad(movers, (1, 0)), dim=2)
    masks = every[..., 1:].transpose(1, 2)  # the movers'

    moving = masks * valid[:, None]
    share = moving / (moving.sum(dim=2, keepdim=True) + 1e-3)
    pooled, centroids = share @ h, share @ local
    everywhere = context(h)[:, None].expand(-1, pooled.shape[1], -1)
    x = activation(linear(p, "motion_1", torch.cat([pooled, everywhere, centroids / 0.1], dim=2)))
    twist = torch.from_numpy(networks.MOTION_UNIT) * linear(p, "motion_3", activation(linear(p, "motion_2", x)))
    moved = local[:, None] @ so3_exp(twist[..., 3:]).transpose(2, 3) + twist[:, :, None, :3]
    return points + (masks[..., None] * (moved - local[:, None])).sum(dim=1) @ axes.transpose(1, 2), every


def at(rows):
    return torch.arange(len(rows))[:, None], rows


def predict(p, sizes, b):
    """-> all predicted points, and the masks of those looked at; networks.predict."""
    rows = at(b["rows"])
    points = b["points"][rows]
    found, masks = forward_model(p, sizes, points, b["seen"], b["pokes"], b["walls"])
    return b["points"].index_put(rows, torch.where(b["seen"][..., None], found, points)), masks


def inverse_model(p, before, after, weights, cells):
    centre = (weights[..., None] * (before + after)).sum(dim=1) / 2
    centre = torch.cat([centre[:, :2], torch.zeros_like(centre[:, 2:])], dim=1)
    amount = torch.log(weights[..., None] * weights.shape[1] + 1e-3) / 5
    x = torch.cat([poke_features(before - centre[:, None]), poke_features(after - centre[:, None]), amount,
                   encode(p, before), encode(p, after)], dim=2)
    x = activation(linear(p, "change_2", activation(linear(p, "change_1", x))))
    seen = weights > 1e-6 * weights.amax(dim=1, keepdim=True)
    pooling = torch.stack([weights, weights ** 0.25, seen], dim=1)
    pooling = pooling / (pooling.sum(dim=2, keepdim=True) + 1e-9)
    context = torch.cat([max_over_points(x, seen), (pooling @ x).flatten(1)], dim=1)
    bias = linear(p, "cell_context_2", activation(linear(p, "cell_context_1", context)))
    local = (cells - centre[:, None, :2]).to(before.dtype)
    y = torch.cat([local / 0.1, fourier(local, (0.4, 0.2, 0.1, 0.05))], dim=2)
    y = activation(activation(linear(p, "cell_1", y)) @ p["cell_2_w"] + bias[:, None])
    y = activation(linear(p, "cell_3", y))
    return linear(p, "heatmaps", y).unbind(-1)


# --- the losses -------------------------------------------------------------------------------------------------

def nearest_by_brute_force(queries, references, valid):
    """Index of every query's nearest valid reference, from the full matrix of distances."""
    distances = torch.cdist(queries, references)
    return distances.masked_fill(~valid[:, None], math.inf).argmin(dim=2)


def nearest_by_tree(queries, references, valid):
    """The same by SciPy's KD-trees."""
    result = np.empty(queries.shape[:2], int)
    for i, (q, r, v) in enumerate(zip(queries.numpy(), references.numpy(), valid.numpy())):
        rows = np.flatnonzero(v)
        result[i] = rows[cKDTree(r[rows], compact_nodes=False, balanced_tree=False).query(q)[1]]
    return torch.from_numpy(result)


def distance_map(queries, references, valid, weights, nearest):
    with torch.no_grad():
        indices = nearest(queries.detach(), references.detach(), valid)
    found = torch.gather(references, 1, indices[..., None].expand(-1, -1, 3))
    return ((queries - found) ** 2).sum(dim=2) * weights


def project(points, camera):
    matrix = torch.from_numpy(camera.camera_from_arena).to(points.dtype)
    points = points @ matrix[:3, :3].T + matrix[:3, 3]
    focal = torch.tensor([camera.fx, camera.fy], dtype=points.dtype)
    return points[..., :2] / points[..., 2:].clamp(min=0.05) * focal + torch.tensor([camera.cx, camera.cy]).to(points)


def smoothness(field, images, valid):
    valid = valid.view(images.shape[:3])
    total = 0
    for dim in (2, 1):
        step = field.diff(dim=dim).abs().sum(dim=3)
        edges = torch.exp(-EDGE_SHARPNESS * images.diff(dim=dim).abs().mean(dim=3))
        both = valid.narrow(dim, 1, valid.shape[dim] - 1) & valid.narrow(dim, 0, valid.shape[dim] - 1)
        total = total + (step * edges * both).sum(dim=(1, 2))
    return total


def photometric(images, next_images, flow, valid):
    height, width = images.shape[1:3]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    last, margin = torch.tensor([width - 1, height - 1]).to(flow), 1e-3
    where = torch.stack([u, v], dim=-1).to(flow) + flow
    in_view = ((where >= -margin) & (where <= last + margin)).all(dim=-1)
    warped = F.grid_sample(next_images.permute(0, 3, 1, 2), 2 * where / last - 1, padding_mode="border",
                           align_corners=True).permute(0, 2, 3, 1)
    return ((images - warped).abs().sum(dim=3) * (in_view & valid.view(in_view.shape))).sum(dim=(1, 2))


def loss_terms(p, sizes, b, camera, nearest):
    """Batch means of all terms; training.loss_terms."""
    (predicted, masks), rows, next_rows = predict(p, sizes, b), at(b["rows"]), at(b["next_rows"])
    embedding = state_embedding(p, predicted[rows], b["occupied"][rows] & b["seen"])
    next_embedding = state_embedding(p, b["next_points"][next_rows],
                                     b["next_occupied"][next_rows] & b["next_seen"])
    start, end = inverse_model(p, b["changed"], b["next_changed"], b["change"], b["centres"])
    images, next_images = b["images"], b["next_images"]
    flow = (project(predicted, camera) - project(b["points"], camera)).view(*images.shape[:3], 2)
    here = distance_map(predicted, b["next_points"], b["next_shared"], b["shared"], nearest)
    there = distance_map(b["next_points"], predicted, b["shared"], b["next_shared"], nearest)
    grid = images.shape[:3] + (1,)
    terms = {
        "chamfer": (here + there).sum(dim=1),
        "distance_smoothness": smoothness(there.view(grid), next_images, b["next_shared"])
        + smoothness(here.view(grid), images, b["shared"]),
        "photometric": photometric(images, next_images, flow, b["shared"]),
        "flow_smoothness": smoothness(flow, images, b["valid"]),
        "inverse": F.cross_entropy(start, b["start"], reduction="none")
        + F.cross_entropy(end, b["end"], reduction="none") + (embedding - next_embedding).abs().mean(dim=1),
        "binary_masks": (masks[..., 0] * (1 - masks[..., 0]) * b["seen"]).sum(dim=1),
    }
    return {name: value.mean() for name, value in terms.items()}


def full_loss(p, sizes, b, camera, weights, nearest):
    """Eq. (6) -> scalar."""
    terms = loss_terms(p, sizes, b, camera, nearest)
    return sum(weights[name] * terms[name] for name in terms)
