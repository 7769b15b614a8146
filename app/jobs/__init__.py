"""Background jobs: rows a user sees, and the engine that runs them. Knows no mathematics."""

from app.jobs.queue import FINAL_STATES, JobQueue

__all__ = ["FINAL_STATES", "JobQueue"]
