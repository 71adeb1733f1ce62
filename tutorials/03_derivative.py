"""A derivative by hand: written, got wrong in two ways, caught, and given to autograd.

Question: autograd differentiates what is written in NumPy. What does one do with a step that it cannot follow, or is
slow at, and how does one notice that the derivative written for it is wrong?

Equations:
- Not in the paper, derivatives by hand: `ops.bilinear_sample`, `ops.squared_distances`, `ops.take`; tests/test_ops.py

Time: 2 s. Pictures: 03_mistakes.png, 03_step.png.

Last lines to expect:
   ops.squared_distances against central differences, relative error: expected below 1e-06, got 5.302e-13
03_derivative: all checks passed
"""
# %% [markdown]
# Step through with the cells below, or run the whole file. `ops.py` holds all derivatives that the package writes by
# hand; each is tested as this lesson shows.

# %%
import lesson  # first of all: it sets the number of BLAS threads

import autograd.numpy as anp
import numpy as np
from autograd import grad
from autograd.extend import defvjp, primitive

from hind4sight_min import ops
from hind4sight_min.lab.figures import BLUE, GREEN, ORANGE, RED

options = lesson.begin("03_derivative")
import matplotlib.pyplot as plt  # after begin(), which chooses whether there are windows

# %% [markdown]
# ## What autograd needs from each step
#
# A loss is a chain of steps y = f(x), with a single number L at its end. Going backwards, each step is told
# g = dL/dy, one number for each entry of y, and has to say dL/dx, one for each entry of x. With the Jacobian
# J_nk = dy_n/dx_k, that is the chain rule:
#
#     dL/dx_k = sum_n g_n J_nk
#
# A function from g to this sum is called a *vector-Jacobian product* (VJP). It need not build J, which is large and
# mostly zeros. autograd has a VJP for every NumPy function; for a step of your own you write one.
#
# ## A step, and its VJP
#
# Our step reads a row of numbers r between its pixels, at places x. With i the pixel to the left of x_n and
# w = x_n - i, the way past it,
#
#     y_n = (1 - w) r_i + w r_{i+1}
#
# In two dimensions that is how a picture is read in lesson 05. There are two inputs, so there are two sums:
#
#     dL/dx_n = g_n (r_{i+1} - r_i)
#     dL/dr_k = sum_n g_n ((1 - w) if k is i, w if k is i + 1, else 0)
#
# The second sum goes over all places that read pixel k. `np.add.at(a, i, b)` adds b[n] to a[i[n]] for every n.

# %%
def read(row, places):
    """(K,) read at places (N,) between its pixels -> (N,)."""
    i = np.floor(places).astype(int)
    w = places - i
    return (1 - w) * row[i] + w * row[i + 1]


def read_vjp(g, row, places):
    """g = dL/dy (N,) -> dL/drow (K,), dL/dplaces (N,)."""
    i = np.floor(places).astype(int)
    w = places - i
    on_row = np.zeros_like(row)
    np.add.at(on_row, i, g * (1 - w))
    np.add.at(on_row, i + 1, g * w)
    return on_row, g * (row[i + 1] - row[i])


row = np.array([0.1, 0.5, 0.4, 0.9, 0.2, 0.3, 0.8])
print("1. The row read at 0.5 and at 2.25:", read(row, np.array([0.5, 2.25])), " by hand 0.3 and 0.525")

# %% [markdown]
# ## Two mistakes that everyone makes once
#
# *g forgotten*: the derivative of y is right, but nobody multiplies by what comes from above. *The last one wins*:
# `a[i] += b` looks like `np.add.at(a, i, b)`, but where i repeats, NumPy adds only the last.
#
# ## The test
#
# A derivative is a slope, and a slope can be measured: change one input by a little and see what L does. *Central
# differences* go both ways,
#
#     dL/dx_k ~ (L(x_k + h) - L(x_k - h)) / (2 h)
#
# and need no calculus, so they cannot share a mistake with us. We need an L: the sum of y, or the sum of y times fixed
# numbers, which then are g.
#
# **Predict before you run:** here are an easy test, L = sum(y) with places far from each other, and a hard one, random
# g and two places in the same cell. Which of the two mistakes does the easy one find?

# %%
def g_forgotten(g, row, places):
    i = np.floor(places).astype(int)
    return read_vjp(g, row, places)[0], row[i + 1] - row[i]


def last_one_wins(g, row, places):
    i = np.floor(places).astype(int)
    w, on_row = places - i, np.zeros_like(row)
    on_row[i] += g * (1 - w)
    on_row[i + 1] += g * w
    return on_row, read_vjp(g, row, places)[1]


def slopes(loss, x, h=1e-5):
    """Central differences of loss() to every entry of the array x, which is changed and changed back."""
    found = np.zeros(x.shape)
    for k in np.ndindex(*x.shape):
        usual = x[k]
        x[k] = usual + h
        above = loss()
        x[k] = usual - h
        below = loss()
        x[k] = usual
        found[k] = (above - below) / (2 * h)
    return found


tests = {"easy": (np.ones(3), np.array([0.3, 2.6, 4.8])),
         "hard": (np.array([0.7, -1.2, 0.4, 0.9]), np.array([0.3, 2.6, 2.2, 4.8]))}  # g, places
versions = {"right": read_vjp, "g forgotten": g_forgotten, "last one wins": last_one_wins}
measured, errors = {}, {}
print("2. Largest difference to central differences")
for test, (g, places) in tests.items():
    measured[test] = [slopes(lambda: np.sum(g * read(row, places)), x) for x in (row, places)]
    for name, vjp in versions.items():
        errors[test, name] = max(np.abs(a - b).max() for a, b in zip(vjp(g, row, places), measured[test]))
for name in versions:
    print(f"   {name:14s}" + ", ".join(f"{test} test {errors[test, name]:7.1e}" for test in tests))

g, places = tests["hard"]
figure, axes = plt.subplots(1, 2, figsize=(11, 3.5), layout="constrained", width_ratios=(1.3, 1))
for panel, which, title in ((axes[0], 0, "dL/dr, one bar group per pixel"), (axes[1], 1, "dL/dx, one per place")):
    count = len(measured["hard"][which])
    for j, ((name, vjp), colour) in enumerate(zip(versions.items(), (GREEN, RED, ORANGE))):
        panel.bar(np.arange(count) + 0.27 * (j - 1), vjp(g, row, places)[which], 0.27, color=colour, label=name)
    panel.hlines(measured["hard"][which], np.arange(count) - 0.42, np.arange(count) + 0.42, color="black", linewidth=2,
                 label="measured")
    panel.axhline(0, color="0.6", linewidth=0.8)
    panel.set_title(title, fontsize=11)
    panel.set_xticks(range(count), range(count) if which == 0 else [f"x = {x:g}" for x in places])
axes[0].legend(fontsize=9)
axes[0].set(xlabel="pixel k", ylabel="derivative")
figure.suptitle("The hard test: central differences (black) see both mistakes", fontsize=11)
lesson.keep(options, figure, "mistakes")

# %% [markdown]
# So a test of a derivative needs a g that is not all ones, inputs of which some are used twice, and no value or slope
# that is zero by chance.
#
# ## How small is "a little"?
#
# The step h can be too large, because a slope is a limit, and too small, because the difference of two nearly equal
# numbers has few digits left. Central differences are exact up to h^2, one-sided ones, (L(x + h) - L(x)) / h, only up
# to h: the slope of sin at 1, measured with both.
#
# And some places have no slope. At a whole x, `read` has a kink: one slope to the left, another to the right. Central
# differences return their mean, a VJP one of the two, and neither is wrong. Test beside kinks, not on them. (Distances
# to the nearest neighbour, |x|, max(x, 0): this package is full of kinks.)

# %%
h = np.logspace(-14, 0, 57)
errors_of_step = {}
for name, kind, one_sided in (("one-sided, float64", np.float64, True), ("central, float64", np.float64, False),
                              ("central, float32", np.float32, False)):
    x, steps = kind(1), h.astype(kind)
    behind = np.sin(x if one_sided else x - steps)
    errors_of_step[name] = np.abs((np.sin(x + steps) - behind) / (steps if one_sided else 2 * steps) - np.cos(1.0))
best = {name: h[values.argmin()] for name, values in errors_of_step.items()}
print("3. Best step: " + ", ".join(f"{name} {step:.0e}" for name, step in best.items()))
kink = np.array([3.0])
left, right = row[3] - row[2], row[4] - row[3]
mean_slope = slopes(lambda: read(row, kink)[0], kink)[0]
print(f"   at the kink x = 3: slope {left:.2f} to the left, {right:.2f} to the right, central difference "
      f"{mean_slope:.2f}, VJP {read_vjp(np.ones(1), row, kink)[1][0]:.2f}")

figure, axes = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
for (name, values), colour, style in zip(errors_of_step.items(), (ORANGE, BLUE, RED), ("-.", "-", "--")):
    axes[0].loglog(h, np.maximum(values, 1e-13), style, color=colour, linewidth=2, label=name)
axes[0].set(xlabel="step h", ylabel="error of the slope", ylim=(1e-13, 10))
axes[0].set_title("the slope of sin at 1: too small is as bad as too large", fontsize=11)
axes[0].legend(fontsize=9)
fine = np.linspace(0, 5.99, 300)
axes[1].plot(fine, read(row, fine), color="0.4", label="y = read(r, x)")
axes[1].plot(np.arange(6), row[:6], "o", color="black", label="pixels")
away = np.array([-0.8, 0.8])
for slope, colour, name in ((left, ORANGE, "slope to the left"), (right, RED, "slope to the right"),
                            (mean_slope, BLUE, "central difference")):
    axes[1].plot(3 + away, row[3] + slope * away, color=colour, linewidth=2, label=name)
axes[1].set(xlabel="place x", ylabel="y", ylim=(0, 2.4))
axes[1].set_title("a kink has no slope", fontsize=11)
axes[1].legend(fontsize=9, ncols=2, loc="upper left")
figure.suptitle("Two ways to be misled by a measured slope", fontsize=11)
lesson.keep(options, figure, "step")

# %% [markdown]
# ## Given to autograd
#
# `primitive` tells autograd not to look inside a function, `defvjp` what its VJP is, one per input. From then on the
# step is one of autograd's own. To see it at work, let gradient descent find by how far a row was moved: the smallest
# sum of (read(moved row, x + U) - row)^2 over U, starting at U = 0. (autograd could have followed `read` by itself. It
# cannot follow OpenCV, which reads our pictures, or SciPy's tree, which finds nearest neighbours.)

# %%
row_read = primitive(read)
defvjp(row_read, lambda y, row, places: lambda g: read_vjp(g, row, places)[0],
       lambda y, row, places: lambda g: read_vjp(g, row, places)[1])

x = np.arange(40.0)
soft, moved = np.exp(-((x - 15) / 5) ** 2), np.exp(-((x - 17.3) / 5) ** 2)


def mismatch(U):
    return anp.sum((row_read(moved, x[5:30] + U) - soft[5:30]) ** 2)


U = 0.0
for _ in range(50):
    U = U - 0.3 * grad(mismatch)(U)
print(f"4. Moved by 2.3 px; gradient descent finds {U:.3f}")

# %% [markdown]
# **Now change this:** `np.add.at(on_row, i, g * (1 - w))` to `on_row[i] += g * (1 - w)`. Gradient descent finds the
# same U as before, because it never asks for the row's gradient: a wrong derivative can sit unnoticed for years. The
# Checks "right VJP, hard test" and "given to autograd" object.

# %% Check
print("5. Check")
lesson.check("the row at 2.25: 0.75 * 0.4 + 0.25 * 0.9", float(read(row, np.array([2.25]))[0]), 0.525, within=1e-12)
lesson.check("right VJP, easy test, largest error", float(errors["easy", "right"]), below=1e-8)
lesson.check("right VJP, hard test, largest error", float(errors["hard", "right"]), below=1e-8)
for name in ("g forgotten", "last one wins"):
    lesson.check(f"{name}, easy test: not noticed", float(errors["easy", name]), below=1e-8)
    lesson.check(f"{name}, hard test: noticed", float(errors["hard", name]), above=0.1)
lesson.check("central difference at the kink: the mean of both slopes", float(mean_slope), (left + right) / 2,
             within=1e-8)
lesson.check("best step in float64, central / one-sided", float(best["central, float64"] / best["one-sided, float64"]),
             above=30)
ours, its_own = (grad(lambda r: anp.sum(g * each(r, places) ** 2))(row) for each in (row_read, read))
lesson.check("given to autograd, largest difference to its own derivative", float(np.abs(ours - its_own).max()),
             below=1e-12)
lesson.check("movement found by gradient descent [px]", float(U), 2.3, within=0.05)


def relative_error(f, x, h):
    """Of autograd's derivative of sum(g f(x)), with random g, against central differences."""
    g = np.random.default_rng(1).standard_normal(f(x).shape)
    by_autograd = grad(lambda x: anp.sum(g * f(x)))(x)
    by_differences = slopes(lambda: np.sum(g * f(x)), x, h)
    return float(np.linalg.norm(by_autograd - by_differences) / np.linalg.norm(by_differences))


rng = np.random.default_rng(0)
picture = rng.random((1, 4, 5, 3), np.float32)
spots = np.array([[[[0.4, 1.6], [2.3, 0.7], [2.6, 0.4]]]])  # (B=1, h=1, w=3, 2) px, beside the kinks
lesson.check("ops.bilinear_sample against central differences, relative error",
             relative_error(lambda x: ops.bilinear_sample(picture, x), spots, 1 / 16), below=1e-3)
cloud, nearest = rng.random((4, 3)), np.array([1, 0, 1, 1])  # three of four have the same neighbour
lesson.check("ops.squared_distances against central differences, relative error",
             relative_error(lambda x: ops.squared_distances(cloud, x, nearest), rng.random((2, 3)), 1e-4), below=1e-6)
lesson.end(options)

# %% [markdown]
# ## Answers
#
# 1. None. Where g is all ones, forgetting it changes nothing; where no index repeats, the last one is the only one.
