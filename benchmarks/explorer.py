"""From mouse to picture: how long the explorer takes to follow the mouse, and to carry out a poke.

    python benchmarks/explorer.py --json docs/results/explorer.json

Synthetic mouse events on Agg, the figure at its usual size, the shipped pokes: every event asks the model and draws
anew what it says. A round is twenty moves of the mouse over an object, and one poke!. A few seconds.
"""
from hind4sight_min.lab.explore import SIZE, explore, play  # before NumPy: it sets the number of BLAS threads

import time

import numpy as np
from matplotlib.backend_bases import MouseEvent
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from race import DATA, parser_of, shown, spread

from hind4sight_min.disk.files import write_json


def main():
    args = parser_of(__doc__, rounds=9).parse_args()
    began = time.perf_counter()
    explorer = explore(data=DATA / "test", figure=FigureCanvasAgg(Figure(SIZE, dpi=100)).figure)
    figures, moves, pokes = {"explorer_start_ms": 1000 * (time.perf_counter() - began)}, [], []
    canvas, camera = explorer.canvas, explorer.art.axes["camera"].transData

    def mouse(name, place):
        canvas.callbacks.process(name, MouseEvent(name, canvas, *camera.transform(place), 1))
    for _ in range(args.rounds):
        rows = np.flatnonzero(explorer.scene.occupied[0])
        y, x = divmod(int(rows[len(rows) // 2]), explorer.camera.width)
        mouse("button_press_event", (x, y))
        for angle in np.linspace(0, 2 * np.pi, 20, endpoint=False):
            before, began = np.array(canvas.buffer_rgba()), time.perf_counter()
            mouse("motion_notify_event", (x + 8 * np.cos(angle), y + 8 * np.sin(angle)))
            moves.append(1000 * (time.perf_counter() - began))
            assert (np.array(canvas.buffer_rgba()) != before).any(), "the picture did not follow"
        mouse("button_release_event", (x, y))
        began = time.perf_counter()
        play(explorer, ["key space"])
        pokes.append(1000 * (time.perf_counter() - began))
        play(explorer, ["key n"])
    for name, values in (("explorer", moves), ("explorer_poke", pokes)):
        figures.update(spread(f"{name}_ms", values))
        print(f"{name:<20} {shown(values)} ms")
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
