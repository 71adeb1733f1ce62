"""Model answers to assignment 7, for tests only: a measurement for each bug, and where it lies if the code is right."""
import numpy as np

EYE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])  # 2 m above the table, looking down


def slope(function, x, step=1e-6):
    """Derivative of a function of one number by central differences."""
    return (function(x + step) - function(x - step)) / (2 * step)


EXPECTED_01 = 0, 1e-9


def measure_01(package):
    """A pixel's point is projected onto the pixel."""
    camera = package.geometry.Camera(5, 4, 6.0, 7.0, 1.3, 2.1, EYE)
    pixels = package.geometry.project(package.geometry.unproject(np.full((4, 5), 1.7), camera), camera)
    return np.abs(pixels - np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1)).max()


EXPECTED_02 = 0, 1e-9


def measure_02(package):
    """R R^T = 1."""
    turn = package.geometry.so3_exp(np.array([0.7, -1.1, 0.5]))
    return np.abs(turn @ turn.T - np.eye(3)).max()


EXPECTED_03 = 0.99, 1.01


def measure_03(package):
    """A cloud moved by 1 mm is 1 mm away from itself, holes or not."""
    cloud = np.random.default_rng(0).normal(size=(1, 50, 3))
    valid = np.arange(50)[None] % 3 > 0
    moved = cloud[valid][None] + [1e-3, 0, 0]
    return np.sqrt(package.ops.nearest_squared_distances(moved, cloud, valid)).max() / 1e-3


EXPECTED_04 = 0.99, 1.01


def measure_04(package):
    """Gradient over central difference."""
    from autograd import grad
    def distance(x):
        return package.ops.squared_distances(np.array([[1.0, 0]]) * x, np.array([[5.0, 1]]), np.array([0]))[0]
    return grad(distance)(2.0) / slope(distance, 2.0)


EXPECTED_05 = 0.99, 1.01


def measure_05(package):
    """The same of a layer with a residual, below its kink while the output is above 0."""
    from autograd import grad
    def layer(bias):
        x, weight = np.array([[3.0]]), np.array([[1.0]])
        return package.ops.dense(x, weight, bias * np.ones(1), leaky=True, residual=True)[0, 0]
    return grad(layer)(-5.0) / slope(layer, -5.0)


EXPECTED_06 = 0, 0


def measure_06(package):
    """A flow that carries all pixels out of view costs nothing."""
    images = np.random.default_rng(0).random((2, 1, 3, 4, 3))
    return package.losses.photometric_loss(*images, np.full((1, 3, 4, 2), 9.0), np.ones((1, 12), bool))[0]


EXPECTED_07 = 0, 0.5


def measure_07(package):
    """An edge of frame t+1 makes a step of its map cheap."""
    step, flat = np.array([[0.0, 1]]), np.zeros((1, 2))
    plain, edge = np.zeros((1, 1, 2, 3)), np.zeros((1, 1, 2, 3)) + [[0], [0.5]]
    valid = np.ones((1, 2), bool)
    return package.losses.distance_smoothness_loss(flat, step, plain, edge, valid, valid)[0]


EXPECTED_08 = 0, 1e-9


def measure_08(package):
    """The cells' centres lie around the arena's middle."""
    return np.abs(package.interactions.cell_centres({"arena": 0.5, "cell": 0.05}).mean(axis=0)).max()


EXPECTED_09 = 0, 0


def measure_09(package):
    """No gradient of the state embedding to the encoder."""
    from autograd import grad
    networks = package.networks
    params = networks.init_parameters(networks.Sizes(), np.random.default_rng(0))
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (1, 8, 3)).astype(np.float32)
    def total(params):
        return networks.state_embedding(params, points, np.ones((1, 8), bool)).sum()
    return np.abs(grad(total)(params)["encoder_2_w"]).max()


EXPECTED_10 = 0.99, 1.01


def measure_10(package):
    """A network that moves everything along the poke moves it along the poke: cosine of both."""
    networks = package.networks
    params = networks.init_parameters(networks.Sizes(), np.random.default_rng(0))
    params["motion_3_b"][0] = 1
    points = np.random.default_rng(1).uniform(0, 0.05, (1, 8, 3)).astype(np.float32)
    poke = np.array([[0.02, 0.03, 1.0]], np.float32)
    moved = networks.forward_model(params, networks.Sizes(), points, np.ones((1, 8), bool), poke).points - points
    mean = moved[0].mean(axis=0)
    return (mean[0] * np.cos(1.0) + mean[1] * np.sin(1.0)) / np.linalg.norm(mean)


EXPECTED_11 = 0.09, 0.11


def measure_11(package):
    """Directions 0.1 rad on both sides of pi spread by 0.1 rad."""
    elites = np.array([[[0, 0, np.pi - 0.1]], [[0, 0, 0.1 - np.pi]]])
    return package.planning.refit(elites)[1][0, 2]


EXPECTED_12 = 0.99, 1.01


def measure_12(package):
    """Adam's first step has the length of the learning rate."""
    from types import SimpleNamespace
    run = SimpleNamespace(first_moment=np.zeros(3), second_moment=np.zeros(3), step=1)
    return np.abs(package.training.adam(run, np.array([1.0, -2, 3]), 0.01)).max() / 0.01
