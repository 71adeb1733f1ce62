"""How long it takes, on one core, to learn to a given flow error: from nothing, for more and more steps.

    python benchmarks/minutes_to.py TRAIN TEST [--ratio 0.11] [--steps 1250 1500 2000 ...] [--json FIGURES]

TRAIN, TEST: folders of `hind4sight collect`. The rate falls to zero over a run's steps, so every number of steps is a
run of its own; the first that reaches the ratio ends the search. Minutes are of processor time: other work on the
machine does not count.
"""
import argparse
import time

from hind4sight_min.disk.files import write_json
from hind4sight_min.disk.shards import load_interactions
from hind4sight_min.lab.evaluation import evaluate
from hind4sight_min.sim.truth import load_truth
from hind4sight_min.training import Recipe, start_run, train


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train")
    parser.add_argument("test")
    parser.add_argument("--ratio", type=float, default=0.11)
    parser.add_argument("--steps", type=int, nargs="+", default=[1250, 1500, 1750, 2000, 2500, 3000])
    parser.add_argument("--learning-rate", type=float, default=Recipe.learning_rate)
    parser.add_argument("--json", metavar="FILE", help="write the figures here too")
    args = parser.parse_args()
    data, test, truth = load_interactions(args.train), load_interactions(args.test), load_truth(args.test)
    figures = {"ratio": args.ratio}
    for steps in sorted(args.steps):
        began = time.process_time()
        run = train(data, start_run(Recipe(steps=steps, seed=1, learning_rate=args.learning_rate), data))
        minutes = (time.process_time() - began) / 60
        ratio = evaluate(run, test, truth)["flow_mse_ratio"]
        print(f"{steps} steps: ratio {ratio:.3f} after {minutes:.1f} minutes", flush=True)
        figures.update({f"steps_{steps}_ratio": ratio, f"steps_{steps}_minutes": minutes})
        if ratio <= args.ratio:
            figures["minutes"] = minutes
            break
    write_json(args.json, figures)


if __name__ == "__main__":
    main()
