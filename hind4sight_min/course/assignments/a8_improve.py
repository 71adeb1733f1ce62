"""Improve the model

All that the lessons are about comes together here: 400 pokes, each two RGB-D pictures and what the finger did, and no
labels. The paper's model trained for a hundred steps on them predicts half of the motion. You make it better.

There is no one way, and that is the point. Train longer, and see when it stops to help. Weigh the terms of Eq. (6)
differently; leave one out and say what it was good for. More noise, fewer masks, another width, another optimiser or
schedule. Pokes can be mirrored and turned, for the table does not mind. Several models can be averaged. Measure on
pokes that you did not train on, with the standard error beside it, and change one thing at a time: of two runs that
differ by less than that, neither is better.
"""
POINTS, MINUTES = 100, 10  # of CPU
BASELINE, TARGET = 0.5, 0.2  # flow_mse_ratio that earns nothing, and all: see docs/teaching.md


def files(assignment):
    """Name -> text of the exercise."""
    return {"improve.py": STARTER, "README.md": README.format(
        number=assignment.number, title=assignment.title, theory=assignment.theory, points=POINTS, baseline=BASELINE,
        target=TARGET, minutes=MINUTES)}


STARTER = '''"""Assignment 8: improve the model. README.md says what to do; this is where you start."""
from hind4sight_min import networks, training


def train(interactions, seed):
    """Train on pokes, an Interactions record -> predict.

    predict(pokes): an Interactions record of M pokes whose pictures after the poke are those before it -> scene flow
    (M, N, 3) in m, by how much each of the N = H W points will have moved, in the arena's frame.
    """
    run = training.start_run(training.Recipe(steps=100, seed=seed), interactions)
    training.train(interactions, run)

    def predict(pokes):
        before, _ = training.scenes_of(pokes)
        return networks.predict(run.params, run.recipe.sizes, before, pokes.pokes).points - before.points
    return predict
'''

README = """# Assignment {number}: {title}

{theory}

## What to do

Change `improve.py`, all of it if you like. `train(interactions, seed)` is given 400 pokes and returns a function
`predict(pokes)`. You have {minutes} minutes of CPU for both together, one process, one thread, 3 GB of memory, no
network, and of libraries this package and what it needs. Whatever you learn from, it is these 400 pokes: a file of
parameters does not go along, only `improve.py` is read.

## How to check

    hind4sight grade . --public

trains as the grader will, and measures on the 400 shipped test pokes, which you have. Look at them, but do not learn
from them.

## How it is graded

On pokes that you do not have, from scenes of neither, each the first of its scene. The score is the squared error of
your scene flow over all points that moved, divided by that of predicting no motion: {baseline} or more earns nothing
(`improve.py` as it is reaches 0.6), {target} or less all {points} points, in between on the line from one to the other.
The leaderboard shows the ratio.
"""
