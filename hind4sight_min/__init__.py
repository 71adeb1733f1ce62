"""Hind4sight-Net in a few readable NumPy files: unsupervised dynamics models from pokes.

Read in this order: geometry, ops, losses, networks, training, interactions, simulator, evaluation.
"""
import os

# Our matrices are small and the batch is spread over processes instead (training.py): a BLAS that
# starts threads of its own then competes with them. Set before NumPy loads, unless the user did.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

__version__ = "0.1.0"
