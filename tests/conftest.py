"""Loads the package before any test loads NumPy: it sets the number of BLAS threads, on which float32 sums depend."""
import hind4sight_min  # noqa: F401
