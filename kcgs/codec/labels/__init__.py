"""The stream of a label map; its modules load numba."""
