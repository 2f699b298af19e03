"""Independent jobs: one after another, in worker processes, or on a Ray cluster."""

from .jobs import ENGINES, Done, Failure
from .run import run_jobs

__all__ = ["ENGINES", "Done", "Failure", "run_jobs"]
