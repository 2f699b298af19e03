"""Independent jobs: one after another, in worker processes, or on a Ray cluster."""

from .jobs import Done, Failure
from .run import ENGINES, run_jobs

__all__ = ["ENGINES", "Done", "Failure", "run_jobs"]
