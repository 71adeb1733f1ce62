"""The explorer driven by a script in place of the mouse: for tests and the animation. Not in the paper."""
import numpy as np
from matplotlib.backend_bases import KeyEvent, MouseEvent

LONGEST = 60  # s, that a film waits


def play(explorer, lines):
    """Do what the lines of a script say, by the events that mouse and keys make.

    drag X Y X Y ...: press, move on to these pixels of the model's picture, let go; goal X Y X Y ...: the same with the
    right button; key K; wait SECONDS, in a film. Raises ValueError naming a line that says something else.
    """
    canvas, camera = explorer.canvas, explorer.art.axes["camera"].transData
    for number, line in enumerate(lines, 1):
        word, *rest = line.split("#")[0].split() or ["wait", 0]
        events, times = [], 1  # that a film shows each picture
        try:
            if word == "key":
                key, = [key for key in explorer.keys if rest == [key.replace(" ", "space")]]
                events, times = [KeyEvent("key_press_event", canvas, key)], 8
            elif word == "wait":
                seconds, = map(float, rest)
                if not 0 <= seconds <= LONGEST:
                    raise ValueError
                if explorer.frames:
                    explorer.frames += explorer.frames[-1:] * round(10 * seconds)
            else:
                corners = np.reshape([float(each) for each in rest], (-1, 2))
                if not (len(corners) and np.abs(corners).max() < 1e6):
                    raise ValueError
                way = np.linspace(corners[:-1], corners[1:], 8, endpoint=False).swapaxes(0, 1).reshape(-1, 2)
                names = ["button_press_event", *(len(way) - 1) * ["motion_notify_event"], "button_release_event"]
                events = [MouseEvent(name, canvas, *camera.transform(place), {"drag": 1, "goal": 3}[word])
                          for name, place in zip(names, [*way, corners[-1]], strict=True)]
        except (KeyError, ValueError):
            raise ValueError(f"script, line {number}: expected drag or goal X Y X Y, key K, or wait SECONDS, 0 to "
                             f"{LONGEST}, got {line.strip()!r}") from None
        filmed = len(explorer.frames or ())
        for event in events:
            canvas.callbacks.process(event.name, event)
        if explorer.frames:
            explorer.frames[filmed:] = [frame for frame in explorer.frames[filmed:] for _ in range(times)]
