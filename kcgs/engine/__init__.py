"""Independent jobs: one after another in this process, in worker processes, or on a Ray cluster."""

from .jobs import run_jobs

__all__ = ["run_jobs"]
