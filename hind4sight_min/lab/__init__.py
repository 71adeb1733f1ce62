"""The laboratory: metrics, baselines, experiments, pictures and the command line. The core needs none of it."""
