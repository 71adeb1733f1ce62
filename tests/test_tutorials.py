"""The lessons keep their word: what they name is there, they run anywhere, and they notice what is broken.

Every script runs in fresh processes, two at a time, on a small budget: as it is, with a planted error, and changed as
its "Now change this" says, after which those Checks must fail that it names, and no others.
"""
import argparse
import multiprocessing
import os
import re
import runpy
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module, util
from pathlib import Path

import numpy as np
import pytest
from autograd.tracer import getval
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT / "docs"), str(ROOT / "tutorials")]
import gallery  # noqa: E402
import lesson  # noqa: E402

SCRIPTS = {path.stem: path for path in sorted(gallery.TUTORIALS.glob("[0-9][0-9]_*.py"))}
SIMULATING = [stem for stem, path in SCRIPTS.items() if "pybullet" in path.read_text()]
BULLET = util.find_spec("pybullet") is not None
TIME_LIMIT = 180  # seconds per process, generous: another machine may be busy
FORKS = multiprocessing.get_context("forkserver")  # it imports once, and forks for each run

# script -> (module, function, what makes a wrong function of the right one)
PLANTED = {
    "00_overview": ("geometry", "optical_flow", lambda right: lambda *args: right(*args)[..., ::-1]),  # U and V swapped
    "01_point_clouds": ("geometry", "unproject",  # the optical axis half a pixel off
                        lambda right: lambda depth, camera: right(depth, replace(camera, cx=camera.cx + 0.5))),
    "02_rigid_motion": ("geometry", "so3_exp",  # the right rotation with half its gradient
                        lambda right: lambda twist: right(0.5 * twist + 0.5 * getval(twist))),
    "03_derivative": ("ops", "bilinear_sample",  # the right colours with half their gradient
                      lambda right: lambda images, at: right(images, 0.5 * at + 0.5 * getval(at))),
    "04_chamfer": ("ops", "nearest_squared_distances", lambda right: lambda *args: right(*args) ** 0.5),  # not squared
    "05_warping": ("losses", "photometric_loss",  # pixels that are not valid count too
                   lambda right: lambda images, after, flow, valid: right(images, after, flow, np.ones_like(valid))),
    "06_smoothness": ("losses", "flow_smoothness_loss",  # blind to the picture's edges
                      lambda right: lambda flow, images, valid: right(flow, 0 * images, valid)),
    "07_poke_simulator": ("interactions", "occupied_grid", lambda right: lambda *x: right(*x).swapaxes(1, 2)),  # x, y
    "08_forward_model": ("networks", "init_parameters",  # motions that do not start as the identity
                         lambda right: lambda *args: {name: value + 0.1 for name, value in right(*args).items()}),
    "09_inverse_model": ("networks", "inverse_model", lambda right: lambda *args: right(*args)[::-1]),  # start and end
    "10_training": ("training", "chunk_gradient",  # uphill
                    lambda right: lambda *args: (lambda terms, gradient: (terms, -gradient))(*right(*args))),
    "11_evaluation": ("lab.evaluation", "poke_errors",  # directions that do not go round
                      lambda right: lambda poke, true: (right(poke, true)[0], np.abs(poke[:, 2] - true[:, 2]))),
    "12_planning": ("planning", "refit", lambda right: lambda x: (x.mean(axis=0), x.std(axis=0))),  # angles as numbers
}
CHANGED = sorted(SCRIPTS.keys() - {"10_training", "11_evaluation"} - set([] if BULLET else SIMULATING))  # 10, 11: slow
CHANGE = re.compile(r"\*\*Now change this:\*\* `(.+?)` to `(.+?)`(.*)")


def change_of(stem):
    """What "Now change this" says -> the script after the change, the names of the Checks that will object."""
    body, _ = SCRIPTS[stem].read_text().split("\n# %% Check\n")
    old, new, says = CHANGE.search(body.replace("\n# ", " ")).groups()
    code = re.sub(r"^#.*\n", "", SCRIPTS[stem].read_text(), flags=re.M)
    assert code.count(old) == 1, f"{stem}: expected {old} once in the code"
    return code.replace(old, new), re.findall(r'"(.+?)"', says)


def plant(stem):
    """Put a wrong function into the package."""
    module, name, wrong = PLANTED[stem]
    right = getattr(import_module(f"hind4sight_min.{module}"), name)
    replacement = wrong(right)
    for loaded in [each for each in sys.modules if each.startswith("hind4sight_min")]:
        if getattr(sys.modules[loaded], name, None) is right:  # also where it was imported by name
            setattr(sys.modules[loaded], name, replacement)


def run(test, stem, folder):
    """In a process of its own: run a script as a test wants to see it."""
    script = SCRIPTS[stem]
    for stream in (1, 2):
        os.dup2(os.open(folder / str(stream), os.O_CREAT | os.O_WRONLY), stream)
    if test == "test_it_runs_without_bullet":
        sys.modules["pybullet"] = None
    elif test == "test_it_runs_anywhere":
        warnings.simplefilter("error")
    else:
        lesson.keep = lambda *_, **__: None  # nobody looks at its pictures, and they take long
    if test == "test_it_notices_a_planted_error":
        plant(stem)
    elif test == "test_it_objects_as_it_says":
        script = folder / script.name
        script.write_text(change_of(stem)[0])
    os.chdir(folder / "cwd")
    sys.argv = [str(script), "--quick", "--out", str(folder / "out")]
    runpy.run_path(str(script), run_name="__main__")


def process(test, stem, folder):
    """Run a script for a test, away from the repository -> CompletedProcess."""
    (folder / "cwd").mkdir()
    if test == "test_it_runs_anywhere" and stem == "00_overview":  # one as a reader would; the others start sooner
        arguments = [sys.executable, "-W", "error", str(SCRIPTS[stem]), "--quick", "--out", str(folder / "out")]
        return subprocess.run(arguments, capture_output=True, text=True, timeout=TIME_LIMIT, cwd=folder / "cwd")
    child = FORKS.Process(target=run, args=(test, stem, folder), daemon=True)
    child.start()
    child.join(TIME_LIMIT)
    assert child.exitcode is not None, f"{stem}: still running after {TIME_LIMIT} s"
    return subprocess.CompletedProcess(test, child.exitcode, *((folder / stream).read_text() for stream in "12"))


@pytest.fixture(scope="module")
def started(request, tmp_path_factory):
    """The processes of all tests that were chosen, two at a time -> {test: (its folder, future)}."""
    with ThreadPoolExecutor(2) as pool, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "tests")]))
        FORKS.set_forkserver_preload(["test_tutorials", "matplotlib.pyplot", "hind4sight_min.lab.control"])
        runs = {}
        for item in request.session.items:
            if item.module is request.module and "done" in item.fixturenames:
                folder = tmp_path_factory.mktemp("run")
                runs[item.name] = folder, pool.submit(process, item.originalname, item.callspec.params["stem"], folder)
        yield runs
        pool.shutdown(cancel_futures=True)


@pytest.fixture
def done(request, stem, started):
    """This test's process, finished -> (CompletedProcess, folder of its pictures)."""
    folder, future = started[request.node.name]
    result = future.result()
    result.stderr = re.sub(r"pybullet build time: .*\n", "", result.stderr)  # Bullet says so wherever it is imported
    assert not list((folder / "cwd").iterdir()), f"{stem} wrote into the working directory"
    return result, folder / "out"


@pytest.mark.parametrize("stem", SCRIPTS)
def test_it_has_all_parts(stem):
    gallery.parse(SCRIPTS[stem])
    source = SCRIPTS[stem].read_text()
    body, answers = source.split("\nlesson.end(options)\n\n# %% [markdown]\n# ## Answers\n#\n")
    assert len(re.findall(r"^# \d\. ", answers, re.M)) == body.count("**Predict before you run:**") > 0
    assert all(line.startswith("# ") for line in answers.splitlines()), "the answers come last"
    assert "lesson.check(" in body.split("\n# %% Check\n")[1] and change_of(stem)


GOOD = '''"""A title: with a colon.

Question: is it right,
and is all of it there?

Equations:
- Eq. (2), Chamfer distance: `losses.distance_maps`, `losses.chamfer_loss`; tests/test_eq2_chamfer.py,
  tests/test_ops.py
- Sec. III-A and IV-A, a poke: `sim.arena.Arena.poke`; tests/test_sim_arena.py

Time: 4 s. Pictures: 42_maps.png, 42_gradient.png,
42_film.gif.

Last lines to expect:
   a sum: expected 1 within 0.1, got 1.02
42_good: all checks passed
"""
'''


def test_what_a_docstring_says(tmp_path):
    path = tmp_path / "42_good.py"
    path.write_text(GOOD)
    found = gallery.parse(path)
    assert (found.number, found.title, found.time) == ("42", "A title: with a colon", "4 s")
    assert found.question == "Is it right, and is all of it there?"
    assert found.equations == [
        ("Eq. (2), Chamfer distance", ["losses.distance_maps", "losses.chamfer_loss"],
         ["tests/test_eq2_chamfer.py", "tests/test_ops.py"]),
        ("Sec. III-A and IV-A, a poke", ["sim.arena.Arena.poke"], ["tests/test_sim_arena.py"])]
    assert found.pictures == ["42_maps.png", "42_gradient.png", "42_film.gif"]
    end = "   a sum: expected 1 within 0.1, got 0.98\n42_good: all checks passed\n"
    assert gallery.as_announced(found, "before\n" + end)
    for wrong in (end + "after\n", end.replace("0.1", "0.2"), end.replace("a sum", "a mean"), ""):
        assert not gallery.as_announced(found, wrong)


@pytest.mark.parametrize("old, new, message", [
    ('"""A title', '0\n"""A title', "lacks its title"),  # no docstring at all
    ("Question:", "Query:", "lacks its question"),
    ("- Eq. (2)", "Eq. (2)", "lacks its equations"),
    ("Time: 4 s.", "Time: short.", "lacks its time"),
    ("Pictures:", "Figures:", "lacks its pictures"),
    ("   a sum: expected 1 within 0.1, got 1.02\n", "", "lacks its lines"),
    ("; tests/test_eq2_chamfer.py", ", tests/test_eq2_chamfer.py", "expected '- what:"),
    ("`losses.chamfer_loss`", "`losses.chamfer`", "no function losses.chamfer in"),
    ("`losses.chamfer_loss`", "`loss.chamfer_loss`", "no function loss.chamfer_loss in"),
    ("`losses.chamfer_loss`", "`losses`", "no function losses in"),
    ("Arena.poke`", "Arena.push`", "no function sim.arena.Arena.push in"),
    ("tests/test_ops.py", "tests/test_op.py", "no file tests/test_op.py"),
    (", 42_gradient.png,\n42_film.gif", "", "two or more pictures"),
    ("42_gradient.png", "41_gradient.png", "two or more pictures"),
    ("42_good: all checks passed", "all checks passed", "expected the last line"),
])
def test_a_docstring_that_breaks_the_form_is_an_error_that_names_the_script(tmp_path, old, new, message):
    path = tmp_path / "42_good.py"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"^42_good.py: .*{re.escape(message)}"):
        gallery.parse(path)


SCRIPT = GOOD + """
import sys
for name in ("42_maps.png", "42_gradient.png", "42_film.gif"):
    open(sys.argv[2] + "/" + name, "w").close()
print("   a sum: expected 1 within 0.1, got", 0.9)
print("42_good: all checks passed")
"""


@pytest.mark.parametrize("old, new, message", [
    ("0.9)", "0.8)", None),  # what is measured may differ
    ('got", 0.9', 'found", 0.9', "expected the last lines"),
    ('"42_film.gif"', "", "it made no picture 42_film.gif"),
    ("import sys", "import syss", "it failed"),
])
def test_a_script_that_breaks_its_word_is_an_error_that_names_the_script(tmp_path, old, new, message):
    path = tmp_path / "42_good.py"
    path.write_text(SCRIPT.replace(old, new))
    with pytest.raises(ValueError, match=f"^42_good.py: {message}") if message else nullcontext():
        assert gallery.run(gallery.parse(path), tmp_path) > 0


def test_pictures_are_made_small(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (300, 1100, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "wide.png")
    (tmp_path / "small.png").write_bytes(gallery.small(tmp_path / "wide.png"))
    with Image.open(tmp_path / "small.png") as picture:
        assert picture.size == (800, 218) and picture.mode == "P"
    (tmp_path / "film.gif").write_bytes(b"GIF89a")
    assert gallery.small(tmp_path / "film.gif") == b"GIF89a"
    (tmp_path / "film.gif").write_bytes(bytes(400_001))
    with pytest.raises(ValueError, match="^film.gif: expected at most 400000 bytes, got 400001"):
        gallery.small(tmp_path / "film.gif")


def test_the_gallery_says_what_the_scripts_say_and_links_to_what_exists():
    found = gallery.tutorials()
    assert gallery.page(found) == gallery.PAGE.read_text(), "run `python docs/gallery.py --text`"
    shown = {name for each in found for name in each.pictures[:gallery.SHOWN]}
    assert shown == {path.name for path in gallery.PICTURES.iterdir()}, "run `python docs/gallery.py`"
    assert sum(path.stat().st_size for path in gallery.PICTURES.iterdir()) < 1.2e6
    targets = re.findall(r"\]\((.+?)\)", gallery.PAGE.read_text())
    assert len(targets) > 6 * len(SCRIPTS)
    for target in targets:
        assert (gallery.PAGE.parent / target).exists(), target


def assert_picture(path):
    """A picture of plausible size with something in it; an animation has frames that differ."""
    with Image.open(path) as picture:
        assert picture.format == {".png": "PNG", ".gif": "GIF"}[path.suffix]
        width, height = picture.size
        frames = [np.asarray(picture.convert("L"))]
        if path.suffix == ".gif":
            picture.seek(picture.n_frames - 1)
            frames.append(np.asarray(picture.convert("L")))
            assert np.abs(frames[0].astype(int) - frames[1]).max() > 20, f"{path.name} does not move"
    assert 500 <= width <= 1700 and 150 <= height <= 1300, f"{path.name}: {width} x {height}"
    assert 4_000 < path.stat().st_size < 500_000, f"{path.name}: {path.stat().st_size} bytes"
    assert all(len(np.unique(frame)) > 16 for frame in frames), f"{path.name} is as good as blank"


def assert_passed(stem, result, out, all_of_them):
    """A script made the pictures that it names and no others; without Bullet it may leave some out."""
    assert result.returncode == 0 and result.stdout.endswith(f"{stem}: all checks passed\n"), result.stderr
    made, named = sorted(path.name for path in out.iterdir()), sorted(gallery.parse(SCRIPTS[stem]).pictures)
    assert made == named if all_of_them else set(made) <= set(named) and len(made) >= 2
    for name in made:
        assert f"   picture: {(out / name).resolve()}\n" in result.stdout, "it does not say where its picture is"
        assert_picture(out / name)


def test_blank_pictures_are_noticed(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (300, 800), dtype=np.uint8)
    for name, picture in (("good.png", noise), ("blank.png", np.where(noise > 128, np.uint8(255), np.uint8(0)))):
        Image.fromarray(picture).save(tmp_path / name)
    assert_picture(tmp_path / "good.png")
    with pytest.raises(AssertionError, match="blank.png"):
        assert_picture(tmp_path / "blank.png")


@pytest.mark.parametrize("stem", SCRIPTS)
def test_it_runs_anywhere(stem, done):
    result, out = done
    assert_passed(stem, result, out, BULLET or stem not in SIMULATING)
    assert result.stderr == ""
    if "options.quick" not in SCRIPTS[stem].read_text():  # with a smaller budget other lines may come
        tutorial = gallery.parse(SCRIPTS[stem])
        assert gallery.as_announced(tutorial, result.stdout), result.stdout


def objections(stem, result):
    """The checks that failed, as a script lists them at its end; each was printed in its place, too."""
    found = re.search(rf"^{stem}: (\d+) of \d+ checks failed\n((?:   .+\n)+)\Z", result.stderr, re.M)
    assert result.returncode == 1 and found, f"{stem} noticed nothing:\n{result.stdout[-1000:]}\n{result.stderr}"
    lines = [line.strip() for line in found[2].splitlines()]
    assert len(lines) == int(found[1]) and all(f"   FAILED: {line}\n" in result.stdout for line in lines)
    return lines


@pytest.mark.parametrize("stem", SCRIPTS)
def test_it_notices_a_planted_error(stem, done):
    assert objections(stem, done[0])


@pytest.mark.parametrize("stem", CHANGED)
def test_it_objects_as_it_says(stem, done):
    _, named = change_of(stem)
    assert named or done[0].returncode == 0, done[0].stderr
    failed = objections(stem, done[0]) if named else []
    assert {next((name for name in named if line.startswith(name)), line) for line in failed} == set(named)


def test_checks_go_on_after_a_failure_and_all_failures_are_listed():
    options = argparse.Namespace(name="42_good")
    lesson.check("a", 1.0, 1.0, within=0)
    lesson.check("b", np.nan, 1.0, within=9.0)
    lesson.check("c", 1.0, above=2)
    with pytest.raises(SystemExit, match=r"(?s)^42_good: 2 of 3 checks failed\n   b: .*got nan\n   c: .*got 1$"):
        lesson.end(options)
    lesson.end(options)  # the next lesson begins anew


@pytest.mark.parametrize("stem", SIMULATING)
def test_it_runs_without_bullet(stem, done):
    assert_passed(stem, *done, False)
    assert "pybullet" in done[0].stdout  # it says what is missing
