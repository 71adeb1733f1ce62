"""A task, what a function answers on its cases, and the verdict on the answers.

`answer` runs where the student's code runs; `judge` compares with the reference in a process the student's code never
enters. Case i is answered with weights_seed=i.
"""
import linecache
import sys
import traceback
import warnings
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType

import autograd.numpy as anp
import numpy as np
from autograd import grad


def plain_call(function, **case):
    """The usual `call`: a case holds the function's arguments, in their order."""
    return function(*case.values())


def single(case):
    """The same case in float32."""
    return {name: value.astype(np.float32) if getattr(value, "dtype", None) == float else value
            for name, value in case.items()}


@dataclass(frozen=True)
class Task:
    """One function to write.

    number: "2.1". name: of the reference, "losses.chamfer_loss": module.function inside hind4sight_min. title: what to
    do, in one line. points, minutes: what it is worth, and takes.
    cases: rng -> list of dicts of arguments, arrays or JSON scalars: the first fixed and small enough to do by hand,
    the others drawn, one of them in float32. call: (function, **case) -> array or tuple of arrays, which makes cameras
    or records of arrays; autograd can differentiate it. gradient: the arguments whose gradient counts for half of the
    points. mistakes: what to say of a wrong answer -> a function that gives it. notes: more for the student, which is
    the docstring where the reference has none.
    """
    number: str
    name: str
    title: str
    points: int
    minutes: int
    cases: callable
    call: callable = plain_call
    gradient: tuple = ()
    mistakes: dict = field(default_factory=dict)
    notes: str = ""

    @property
    def function(self):
        """The function's own name, without its module."""
        return self.name.rpartition(".")[2]

    @property
    def reference(self):
        """The reference's function. Raises AttributeError where there is none of that name."""
        return getattr(import_module("hind4sight_min." + self.name.rpartition(".")[0]), self.function)


@dataclass(frozen=True)
class Answer:
    """What a function says on one case: its values, the gradients by argument, and what went wrong, or None. A function
    that fails has no values; one that cannot be differentiated no gradients.
    """
    value: tuple = ()
    gradients: dict = field(default_factory=dict)
    error: str = None


@dataclass(frozen=True)
class Verdict:
    """On all cases together. Without a gradient to judge, gradient_ok is value_ok. sentence: "" where all is right."""
    value_ok: bool
    gradient_ok: bool
    sentence: str

    @property
    def share(self):
        """Of the task's points: half for the value, half for the gradient."""
        return (self.value_ok + self.gradient_ok) / 2


# --- where the student's code runs -----------------------------------------------------------------------------------

def answer(task, function, case, weights_seed):
    """What a function says on one case -> Answer: its values, and the gradients of sum(weights * values)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = _arrays(task.call(function, **_copy(case)))
    except Exception as error:
        return Answer(error=described(error))
    rng = np.random.default_rng(weights_seed)
    weights = [_weights(rng, each) if each.dtype.kind == "f" else None for each in value]

    def total(name, argument):
        found = task.call(function, **{**_copy(case), name: argument})
        found = found if isinstance(found, tuple) else (found,)
        return sum(anp.sum(weight * each) for weight, each in zip(weights, found) if weight is not None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            gradients = {name: np.asarray(grad(total, 1)(name, case[name].copy())) for name in task.gradient}
    except Exception as error:
        return Answer(value, error=described(error))
    return Answer(value, gradients)


def answers_of(task, function, cases):
    """The Answers on a list of cases."""
    return [answer(task, function, case, i) for i, case in enumerate(cases)]


def _copy(case):
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in case.items()}


def _arrays(value):
    arrays = tuple(np.asarray(each) for each in (value if isinstance(value, tuple) else (value,)))
    if any(each.dtype.kind not in "bifu" for each in arrays):
        raise TypeError("returned None: is a `return` missing?" if value is None else "returned something else than "
                        f"arrays of numbers: {type(value).__name__}")
    return arrays


def _weights(rng, value):
    """Between 0.5 and 2, signs alternating, so that the outputs are told apart."""
    signs = np.where(np.arange(value.size).reshape(value.shape) % 2, -1, 1)
    return (signs * rng.uniform(0.5, 2, value.shape)).astype(value.dtype)


def described(error):
    """One line of an exception, with the last line of the student's file that it went through."""
    text = f"{type(error).__name__}: {error}".split("\n")[0]
    places = [(frame, line) for frame, line in traceback.walk_tb(error.__traceback__)
              if frame.f_globals.get("__name__", "").startswith("student_")]
    if isinstance(error, NotImplementedError) or not places:
        return text
    frame, line = places[-1]
    return f"{text} (line {line}: {linecache.getline(frame.f_code.co_filename, line).strip()})"


def namespace_of(path):
    """Run a student's file under a private name, never from a cache -> its names."""
    module = ModuleType(f"student_{Path(path).stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses look for it there
    exec(compile(Path(path).read_bytes(), str(path), "exec", dont_inherit=True), vars(module))
    return vars(module)


# --- where it does not -----------------------------------------------------------------------------------------------

TOLERANCE = {4: 1e-4, 8: 1e-6}  # by bytes per number, of the largest number expected


def judge(task, cases, answers):
    """Compare with the reference: shape, dtype, finite numbers, value and gradient, in this order -> Verdict.

    Raises RuntimeError where the reference itself fails: that is no student's fault.
    """
    expected = answers_of(task, task.reference, cases)
    for each in expected:
        if each.error:
            raise RuntimeError(f"task {task.number}: the reference fails: {each.error}")
    names = [f"case {i}" if i else "the case by hand" for i in range(len(cases))]
    in_value = in_gradient = ""
    for i, (found, wanted, name) in enumerate(zip(answers, expected, names)):
        in_value = in_value or _wrong_value(found, wanted, name, show=i == 0)
        in_gradient = in_gradient or _wrong_gradient(found, wanted, name, show=i == 0)
    if len(answers) != len(cases):
        in_value = in_gradient = in_value or f"{len(answers)} of {len(cases)} cases were answered"
    value_ok, gradient_ok = not in_value, not (in_gradient if task.gradient else in_value)
    if value_ok and gradient_ok:
        return Verdict(True, True, "")
    sentence = _known_mistake(task, cases, answers, value_ok) or (
        in_value if in_value else f"The value is right, its gradient is not. {in_gradient}")
    return Verdict(value_ok, gradient_ok, sentence)


def _wrong_value(found, expected, name, show):
    if not found.value:
        return found.error or "no answer"
    if len(found.value) != len(expected.value):
        return f"Value, {name}: expected {len(expected.value)} arrays, got {len(found.value)}"
    for i, (one, other) in enumerate(zip(found.value, expected.value)):
        wrong = difference(one, other, show)
        if wrong:
            return f"Value{f' {i + 1} of {len(expected.value)}' if len(expected.value) > 1 else ''}, {name}: {wrong}"
    return ""


def _wrong_gradient(found, expected, name, show):
    if found.error:
        return f"{found.error} (does every step use anp, autograd's NumPy, and assign to no part of an array?)"
    for argument, other in expected.gradients.items():
        wrong = difference(found.gradients[argument], other, show) if argument in found.gradients else "none"
        if wrong:
            return f"Gradient with respect to {argument}, {name}: {wrong}"
    return ""


def difference(found, expected, show=False):
    """What is wrong with one array, in words, or "": shape, dtype, finite numbers, value. show: tell the numbers."""
    if found.shape != expected.shape:
        return f"expected shape {expected.shape}, got {found.shape}"
    if found.dtype != expected.dtype and (expected.dtype.kind == "f" or found.dtype.kind != expected.dtype.kind):
        hint = (" (a whole-number or float64 array beside it makes float64 of float32, and so do the derivatives of "
                "anp.max and anp.mean)") * (found.dtype == float)
        return f"expected dtype {expected.dtype}, got {found.dtype}{hint}"
    strange = ~np.isfinite(found) & np.isfinite(expected)
    if strange.any():
        return f"NaN or infinity in {np.count_nonzero(strange)} of {found.size} numbers"
    if same(found, expected):
        return ""
    if show:
        return f"expected {_short(expected)}, got {_short(found)}"
    if not np.array_equal(np.isfinite(found), np.isfinite(expected)):
        return "finite numbers where NaN is expected"
    if expected.dtype.kind != "f":
        return f"wrong in {np.count_nonzero(found != expected)} of {found.size} places"
    largest = np.nanargmax(np.abs(expected))
    factor = found.flat[largest] / expected.flat[largest]
    if abs(factor) > 1e-3 and same(found, factor * expected):
        return f"{factor:.4g} times what is expected, everywhere"
    away = np.nanmax(np.abs(found - expected)) / np.nanmax(np.abs(expected))
    return f"wrong by up to {away:.1%} of the largest number expected"


def same(found, expected):
    """Whether two arrays have one shape and, but for rounding, the same numbers; NaN is NaN."""
    if found.shape != expected.shape:
        return False
    if found.dtype.kind != "f" or expected.dtype.kind != "f":
        return np.array_equal(found, expected)
    size = np.abs(expected[np.isfinite(expected)]).max(initial=0)
    coarse = max(TOLERANCE[min(each.dtype.itemsize, 8)] if each.dtype.itemsize >= 4 else 1e-2
                 for each in (found, expected))
    return np.allclose(found, expected, rtol=0, atol=coarse * size, equal_nan=True)


def _short(array):
    return np.array2string(array, precision=5, threshold=24, separator=", ").replace("\n", "")


def _known_mistake(task, cases, answers, value_ok):
    """The sentence of the mistake that gives the same answers, in value and gradient or else in value; or None."""
    wrong = {sentence: answers_of(task, function, cases) for sentence, function in task.mistakes.items()}
    for with_gradients in (True, False) if not value_ok else (True,):
        for sentence, given in wrong.items():
            if len(given) == len(answers) and all(_alike(*pair, with_gradients) for pair in zip(answers, given)):
                return sentence
    return None


def _alike(found, given, with_gradients):
    def all_same(one, other):
        return len(one) == len(other) and all(same(*pair) for pair in zip(one, other))
    if not found.value or not all_same(found.value, given.value):
        return False
    return not with_gradients or found.gradients.keys() == given.gradients.keys() and all_same(
        [*found.gradients.values()], [given.gradients[name] for name in found.gradients])
