"""The lessons at a glance: run them all and write docs/gallery.md with their pictures.

    python docs/gallery.py
    python docs/gallery.py --text

The first runs every script of tutorials/, two at a time, and makes docs/gallery/ from the first two pictures each of
them names; a minute or two. The second leaves the pictures as they are. Everything that docs/gallery.md says about a
lesson comes from the script's opening docstring, read without running it; a test fails while the page says anything
else.
"""
import ast
import importlib
import io
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
from PIL import Image

from hind4sight_min.disk.files import whole_file, write_text

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS, PAGE, PICTURES = ROOT / "tutorials", ROOT / "docs" / "gallery.md", ROOT / "docs" / "gallery"
SHOWN, WIDTH, LARGEST_GIF = 2, 800, 400_000  # pictures per lesson, px, bytes
DIAGRAM = 1200  # px; what is wider is text in boxes and would be unreadable made small

# what a tutorial's docstring consists of, in this order
PARTS = {
    "title": r"\A(\S.*)\n\n",
    "question": r"^Question: ((?:.+\n)+)",
    "equations": r"^Equations:\n((?:- .+\n(?:  .+\n)*)+)",
    "time": r"^Time: (\d+ s)\.",
    "pictures": r"^Time: .*?Pictures: ((?:.+\n)+)",
    "lines": r"^Last lines to expect:\n(.+\n.+)\Z",
}
EQUATION = re.compile(r"- (?P<what>.+?): (?P<functions>`[\w.]+`(?:, `[\w.]+`)*); (?P<tests>tests/\w+\.py"
                      r"(?:, tests/\w+\.py)*)")

OPENING = """\
# The lessons

Each script below takes one idea of the model apart; the first says why in this order, and what to know before. Open
it in an editor that knows `# %%` cells and step through it, or run it whole: `python tutorials/04_chamfer.py`
prints what it finds, saves its pictures in `runs/tutorials` and ends with checks of its own, which list what is
wrong. Each asks for a prediction before it shows the answer, and proposes a change and says which check will
object. `--show` opens the pictures, `--out` chooses another folder, `--quick` takes a smaller budget where there is
something to save. They need no more than the package and the data that comes with it."""

MAP = """\
## From the paper's equations to the code

Every equation and section that a lesson is about, the functions that compute it, the files that test them, and where
to step through them."""

NOTEBOOKS = """\
## As notebooks

VS Code, Spyder and PyCharm run the `# %%` cells of the scripts as they are. For Jupyter, jupytext makes notebooks of
them:

```
pip install jupytext notebook
jupytext --to notebook tutorials/04_chamfer.py   # writes tutorials/04_chamfer.ipynb
jupyter notebook tutorials/04_chamfer.ipynb
```

Start it in the folder of the scripts, beside `lesson.py`. Notebooks are not kept in the repository; the scripts are
what is tested."""


@dataclass(frozen=True)
class Tutorial:
    """What a script's opening docstring says."""
    path: Path
    title: str
    question: str
    equations: list  # of (what, names of functions, names of test files)
    time: str
    pictures: list
    lines: list  # the last ones it prints

    @property
    def number(self):
        return self.path.name[:2]


def module_of(name):
    """`losses` of `losses.chamfer_loss`, `lab.evaluation` of `lab.evaluation.ask`."""
    parts = name.split(".")
    return ".".join(parts[:1 + (parts[0] in ("sim", "lab"))])


def source_of(name):
    """The file of a function: hind4sight_min/lab/evaluation.py of `lab.evaluation.ask`."""
    return f"hind4sight_min/{module_of(name).replace('.', '/')}.py"


def function_exists(name):
    """Is `module.function`, `module.Class.method` or `lab.module.function` in the package?"""
    module = module_of(name)
    try:
        found = importlib.import_module(f"hind4sight_min.{module}")
        for attribute in filter(None, name[len(module):].split(".")):
            found = getattr(found, attribute)
    except (ModuleNotFoundError, AttributeError):
        return False
    return name != module


def parse(path):
    """Read a script's docstring -> Tutorial. Raises ValueError naming the script and what is wrong with it."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    parts = {}
    for name, pattern in PARTS.items():
        match = re.search(pattern, text, re.MULTILINE)
        if not match:
            raise ValueError(f"{path.name}: its docstring lacks its {name}, or in the wrong form; see 04_chamfer.py")
        parts[name] = match.group(1)
    equations = []
    for line in parts["equations"].replace("\n  ", " ").splitlines():  # a line may go on, indented
        match = EQUATION.fullmatch(line)
        if not match:
            raise ValueError(f"{path.name}: expected '- what: `module.function`, ...; tests/file.py', got {line!r}")
        functions, tests = re.findall(r"`(.+?)`", match["functions"]), match["tests"].split(", ")
        for function in functions:
            if not function_exists(function):
                raise ValueError(f"{path.name}: there is no function {function} in the package")
        for test in tests:
            if not (ROOT / test).exists():
                raise ValueError(f"{path.name}: there is no file {test}")
        equations.append((match["what"], functions, tests))
    pictures = re.split(r",\s+", parts["pictures"].strip().removesuffix("."))
    if len(pictures) < 2 or not all(re.fullmatch(path.name[:2] + r"_\w+\.(png|gif)", name) for name in pictures):
        raise ValueError(f"{path.name}: expected two or more pictures {path.name[:2]}_*.png, got {pictures}")
    lines, question = parts["lines"].splitlines(), " ".join(parts["question"].split())
    if lines[-1] != f"{path.stem}: all checks passed":
        raise ValueError(f"{path.name}: expected the last line '{path.stem}: all checks passed', got {lines[-1]!r}")
    return Tutorial(path, parts["title"].rstrip("."), question[0].upper() + question[1:], equations, parts["time"],
                    pictures, lines)


def tutorials():
    return [parse(path) for path in sorted(TUTORIALS.glob("[0-9][0-9]_*.py"))]


def as_announced(tutorial, output):
    """Does what a script printed end as its docstring says, but for the figures measured?"""
    def fixed(lines):
        return [line.split(", got ")[0] for line in lines]
    return fixed(output.splitlines()[-len(tutorial.lines):]) == fixed(tutorial.lines)


# --- the page ----------------------------------------------------------------------------------------

def table(head, rows):
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def link(path, text):
    return f"[{text}](../{path})"


def says(tutorial, name):
    """What a picture shows, for those who cannot see it: the title that the script gives it, else the lesson's own."""
    kept = re.split(rf'lesson\.keep\(options, \w+, "{Path(name).stem[3:]}"', tutorial.path.read_text())
    titles = re.findall(r'\.suptitle\(((?:\s*f?"(?:[^"\\]|\\.)*")+)', kept[0]) if len(kept) > 1 else []
    if not titles or "lesson.keep" in kept[0].rpartition(".suptitle(")[2]:  # that was another picture's
        return tutorial.title
    text = "".join(re.findall(r'"((?:[^"\\]|\\.)*)"', titles[-1]))
    return re.sub(r"\{[^}]*\}", "\u2026", text).replace("$", "").replace("[", "(").replace("]", ")")


def section(tutorial):
    pictures = "\n\n".join(f"![{says(tutorial, name)}](gallery/{name})" for name in tutorial.pictures[:SHOWN])
    ending = "\n".join(["```", *tutorial.lines, "```"])
    script = link(f"tutorials/{tutorial.path.name}", f"`tutorials/{tutorial.path.name}`")
    return (f"## {tutorial.number} {tutorial.title}\n\n{tutorial.question}\n\n{pictures}\n\n"
            f"{script} ends with\n\n{ending}")


def place_in_paper(what):
    """A sort key: equations by number, then sections by number, then what is neither."""
    equation, part = re.match(r"Eq\. \((\d)\)", what), re.search(r"Sec\. ([IVX]+)-([A-Z])", what)
    if equation:
        return 0, int(equation[1]), ""
    return (1, ["I", "II", "III", "IV", "V"].index(part[1]), part[2]) if part else (2, 0, "")


def equation_map(found):
    """A row for each equation, of all tutorials that name it."""
    rows = {}
    for tutorial in found:
        for what, *names in tutorial.equations:
            for cell, new in zip(rows.setdefault(what, ([], [], [])), (*names, [tutorial.path.name])):
                cell.extend(name for name in new if name not in cell)
    lines = []
    for what in sorted(rows, key=place_in_paper):
        functions, tests, scripts = rows[what]
        lines.append([what,
                      ", ".join(link(source_of(name), f"`{name}`") for name in functions),
                      ", ".join(link(name, f"`{Path(name).name}`") for name in tests),
                      ", ".join(link(f"tutorials/{name}", name[:2]) for name in scripts)])
    return table(["paper", "functions", "tests", "lesson"], lines)


def page(found):
    order = table(["", "lesson", "time"],
                  [[link(f"tutorials/{each.path.name}", each.number), each.title, each.time] for each in found])
    parts = [OPENING, "Read them in this order; each also stands on its own.\n\n" + order, *map(section, found),
             MAP + "\n\n" + equation_map(found), NOTEBOOKS]
    return "\n\n".join(parts) + "\n"


# --- the pictures ------------------------------------------------------------------------------------

def run(tutorial, out):
    """Run a script as a reader would -> seconds. Raises ValueError if it fails or ends otherwise than announced."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, str(tutorial.path), "--out", str(out)], capture_output=True, text=True,
                          timeout=300)
    if done.returncode:
        raise ValueError(f"{tutorial.path.name}: it failed:\n{done.stderr}")
    if not as_announced(tutorial, done.stdout):
        raise ValueError(f"{tutorial.path.name}: expected the last lines {tutorial.lines}, got\n{done.stdout}")
    for name in tutorial.pictures:
        if not (Path(out) / name).exists():
            raise ValueError(f"{tutorial.path.name}: it made no picture {name}")
    return time.perf_counter() - start


def small(path):
    """The bytes of a picture as the page shows it: no wider than WIDTH, 256 colours; an animation as it is."""
    if path.suffix == ".gif":
        if path.stat().st_size > LARGEST_GIF:
            raise ValueError(f"{path.name}: expected at most {LARGEST_GIF} bytes, got {path.stat().st_size}")
        return path.read_bytes()
    picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    height, width = picture.shape[:2]
    if WIDTH < width <= DIAGRAM:
        picture = cv2.resize(picture, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    stream = io.BytesIO()
    Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def draw(found):
    """Run all scripts and make docs/gallery/ from their pictures; what no script shows any more goes."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        for tutorial, seconds in zip(found, pool.map(lambda each: run(each, folder), found)):
            print(f"{tutorial.path.name}: {seconds:.1f} s, its docstring says {tutorial.time}")
        pictures = {name: small(Path(folder) / name) for each in found for name in each.pictures[:SHOWN]}
    for name, content in pictures.items():
        with whole_file(PICTURES / name) as temporary:
            temporary.write_bytes(content)
    for path in PICTURES.iterdir():
        if path.name not in pictures:
            path.unlink()
    print(f"docs/gallery: {len(pictures)} pictures, {sum(map(len, pictures.values())) / 1e6:.2f} MB")


def main(arguments):
    if arguments not in ([], ["--text"]):
        sys.exit(__doc__)
    try:
        found = tutorials()
        if not arguments:
            draw(found)
    except ValueError as error:
        sys.exit(str(error))
    write_text(PAGE, page(found))


if __name__ == "__main__":
    main(sys.argv[1:])
