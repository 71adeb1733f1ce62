"""Warping and the photometric loss

If the optical flow (U, V) of frame t is right, every pixel of I_t is found again in I_{t+1}, U pixels to the right and
V pixels down of where it was:

    I'_t(x, y) = I_{t+1}(x + U, y + V)                      backward warping
    L_rec = sum_xy |I_t - I'_t|_1                           Eq. (3)

*Backward*: every pixel of frame t asks where to look, so that none is left empty. Pixels that the flow carries out of
view have nothing to be compared with and cost nothing.

**Between pixels** the value is the bilinear mean of the four around the position. With x = i + a, y = j + b,
0 <= a, b < 1, and pixel centres at whole numbers:

    I(x, y) = (1-a)(1-b) I[j,i] + a (1-b) I[j,i+1] + (1-a) b I[j+1,i] + a b I[j+1,i+1]

Outside the picture it is the nearest pixel of the border. The loss learns from the slope: within the cell it is the
difference of the two columns, interpolated along y,

    dI/dx = (1-b) (I[j,i+1] - I[j,i]) + b (I[j+1,i+1] - I[j+1,i])

and 0 outside. `cv2.remap` samples in one call, or write the four terms in NumPy: both count, and so the sampling is a
primitive whose VJP with respect to the position is written by hand.

Paper: Sec. III-C; tutorials/05_warping.py.
"""
import autograd.numpy as anp
import numpy as np

from ...losses import photometric_loss, warp_backward
from ...ops import _bilinear_position_vjp, bilinear_sample
from ..task import Task, single


def eighths(rng, low, high, shape):
    """Odd multiples of 1/8 px: between pixels, where there is a slope; and whatever OpenCV rounds is exact there."""
    return (2 * rng.integers(4 * low, 4 * high, shape) + 1) / 8


# --- sampling, and its VJP ---

def sample_cases(rng):
    by_hand = {"images": np.arange(6.0).reshape(1, 2, 3, 1) ** 2,
               "positions": np.array([[[[0.5, 0], [1.25, 0.5], [9, 0.5]]]])}
    drawn = [{"images": rng.random((2, 5, 7, 3)), "positions": eighths(rng, -1, 6, (2, 3, 4, 2))} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def pull_cases(rng):
    cases = sample_cases(rng)
    for case in cases:
        images, positions = case["images"], case["positions"]
        case["positions"] = positions + np.array([0, 0.125]) * (case is cases[0])
        case["positions"] = case["positions"].astype(positions.dtype)
        case["g"] = rng.uniform(0.5, 2, positions.shape[:3] + images.shape[3:]).astype(images.dtype)
    cases[0]["g"] = np.array([1.0, 10, 100]).reshape(1, 1, 3, 1)
    return cases


def pull(function, images, positions, g):
    return function(bilinear_sample(images, positions), images, positions)(g)


def changed(change):
    """A wrong VJP: the right one with its result changed, (result, g, images, positions) -> result."""
    def maker(ans, images, positions):
        def right(g):
            return _bilinear_position_vjp(ans, images, positions)(g)
        return lambda g: change(right, g, images, positions)
    return maker


def inside(images, positions):
    return np.all((positions >= 0) & (positions <= np.array(images.shape[2:0:-1]) - 1), axis=-1)


def beyond_border(right, g, images, positions):
    """The slope in the last cell goes on outside, as when only the sampling is clipped."""
    last = np.array(images.shape[2:0:-1]) - 1.125
    return _bilinear_position_vjp(None, images, np.clip(positions, 0.125, last).astype(positions.dtype))(g)


def at_edge(right, g, images, positions):
    """The slope along x for y rounded down, and the other way round."""
    def slope(axis):
        where = np.where(np.arange(2) == axis, positions, np.floor(positions)).astype(positions.dtype)
        return _bilinear_position_vjp(None, images, where)(g)[..., axis]
    return np.stack([slope(0), slope(1)], axis=-1)


# --- warping, and the loss ---

def warp_cases(rng):
    by_hand = {"next_images": np.array([[1.0, 2, 4, 8], [0, 0, 16, 0]]).reshape(1, 2, 4, 1),
               "flow": np.zeros((1, 2, 4, 2)) + [0.5, 0.25]}
    drawn = [{"next_images": rng.random((2, 5, 7, 3)), "flow": eighths(rng, -2, 2, (2, 5, 7, 2))} for _ in range(2)]
    return [by_hand, drawn[0], single(drawn[1])]


def loss_cases(rng):
    cases = []
    for case in warp_cases(rng):
        shape = case["next_images"].shape
        cases.append({"images": rng.random(shape).astype(case["flow"].dtype), **case,
                      "valid": rng.random((shape[0], shape[1] * shape[2])) < 0.8})
    cases[0].update(images=np.full((1, 2, 4, 1), 3.0), valid=np.arange(8).reshape(1, 8) > 0)
    return cases


def loss_with(distance, in_view_only=True):
    """Eq. (3) with something else than |.|, or over more pixels."""
    def loss(images, next_images, flow, valid):
        warped, in_view = warp_backward(next_images, flow)
        counts = np.reshape(valid, in_view.shape) & (in_view | (not in_view_only))
        return anp.sum(distance(images - warped) * counts[..., None], axis=(1, 2, 3))
    return loss


TASKS = (
    Task("3.1", "ops.bilinear_sample", "Image values between pixels", 25, 30, sample_cases, mistakes={
        "The nearest pixel instead of the mean of four":
            lambda images, positions: bilinear_sample(images, np.floor(positions + 0.5)),
        "The pixel above and to the left instead of the mean of four":
            lambda images, positions: bilinear_sample(images, np.floor(positions)),
        "x and y swapped: positions are (x right, y down), pictures [row, column]":
            lambda images, positions: bilinear_sample(images, positions[..., ::-1]),
        "0 outside of the picture instead of its nearest pixel":
            lambda images, positions: bilinear_sample(images, positions) * inside(images, positions)[..., None]},
         notes="An autograd primitive: it sees plain arrays, so its body is NumPy or OpenCV. Positions lie at "
               "multiples of 1/8 px: what OpenCV rounds does not matter."),
    Task("3.2", "ops._bilinear_position_vjp", "The VJP of bilinear_sample for the positions, by hand", 30, 45,
         pull_cases, pull, mistakes={
             "x and y swapped": changed(lambda right, g, *_: right(g)[..., ::-1]),
             "g is missing: each channel's slope times its g, summed": changed(lambda right, g, *_: right(0 * g + 1)),
             "The slope goes on outside of the picture: there it is 0": changed(beyond_border),
             "The slope along the upper or left edge of the cell: interpolate along the other axis": changed(at_edge),
             "Minus the slope: the right column minus the left one, the lower row minus the upper one":
                 changed(lambda right, g, *_: -right(g))},
         notes="ans are the sampled values (B, h, w, C). It returns a function vjp(g), g in the shape of ans, that "
               "returns the gradient with respect to the positions, in their shape and dtype. Per position: the sum "
               "over the channels of g times the slope."),
    Task("3.3", "losses.warp_backward", "Frame t+1 pulled back along the flow", 20, 20, warp_cases, gradient=("flow",),
         mistakes={
             "Minus the flow": lambda image, flow: warp_backward(image, -flow),
             "x and y swapped": lambda image, flow: warp_backward(image, flow[..., ::-1]),
             "The flow taken for a position: add each pixel's own":
                 lambda image, flow: (bilinear_sample(image, flow), warp_backward(image, flow)[1]),
             "Everything is in view":
                 lambda image, flow: (warp_backward(image, flow)[0], np.ones(flow.shape[:3], bool)),
             "Half a pixel off: pixel centres are whole numbers":
                 lambda image, flow: warp_backward(image, flow + flow.dtype.type(0.5))},
         notes="in_view is a plain bool array: `getval` takes the positions out of autograd's box. The border itself "
               "is in view, and so is what lies 0.001 px beyond it, for rounding."),
    Task("3.4", "losses.photometric_loss", "Eq. (3)", 25, 15, loss_cases, gradient=("images", "flow"), mistakes={
        "Squared: Eq. (3) has the absolute value": loss_with(lambda away: away ** 2),
        "The sign is kept: where is |.|?": loss_with(lambda away: away),
        "The mean instead of the sum":
            lambda a, b, flow, valid: photometric_loss(a, b, flow, valid) / float(np.prod(a.shape[1:])),
        "Pixels that leave the view cost": loss_with(anp.abs, in_view_only=False),
        "Pixels that are not valid cost": lambda a, b, flow, valid: photometric_loss(a, b, flow, valid | True),
        "Minus the flow": lambda a, b, flow, valid: photometric_loss(a, b, -flow, valid),
        "The two frames are swapped: frame t+1 is pulled back":
            lambda a, b, flow, valid: photometric_loss(b, a, flow, valid)}),
)
TESTS = ("eq3_photometric",)
