"""Every metric that is counted as things happen; `/metrics` and the port of a worker show those of their process.

Labels have few values that are known beforehand. Nothing is counted per organisation, building, floor, key, track or
job: such series would grow with the data, and would tell one organisation of another. What is looked up when somebody
asks is in `app.services.installation_metrics`.
"""

import platform

from prometheus_client import Counter, Gauge, Histogram, Info, disable_created_metrics

from app import __version__

__all__ = [
    "AUTH_FAILURES",
    "BLOB_ERRORS",
    "BLOB_SECONDS",
    "HTTP_REQUESTS",
    "HTTP_SECONDS",
    "JOBS_ENDED",
    "JOB_STEP_SECONDS",
    "LOCATE_ESTIMATES",
    "LOCATE_FIXES",
    "LOCATE_FLOORS",
    "LOCATE_SEARCH_SECONDS",
    "LOCATE_SECONDS",
    "LOCATE_WAITING_SECONDS",
    "MAP_CACHE_BYTES",
    "MAP_CACHE_EVICTIONS",
    "MAP_CACHE_LOAD_SECONDS",
    "MAP_CACHE_LOOKUPS",
    "PROBLEMS",
    "TRACK_BATCH_SECONDS",
    "TRACK_STEPS",
    "UPLOADS",
    "UPLOAD_BYTES",
    "UPLOAD_PARSE_SECONDS",
    "WORKERS_TAKEN_OVER",
]

_QUICK_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_LONG_S = (0.1, 0.5, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0)
_SIZES = tuple(4.0**k * 1024 for k in range(9))  # 1 KiB to 64 MiB

disable_created_metrics()  # type: ignore[no-untyped-call]  # a second series of each, of no use here

Info("isodyn_build", "Which Isodyn runs.").info({"version": __version__, "python": platform.python_version()})

HTTP_REQUESTS = Counter("isodyn_http_requests", "Requests served.", ("method", "route", "status"))
HTTP_SECONDS = Histogram("isodyn_http_request_seconds", "Time to serve a request.", ("method", "route"))
PROBLEMS = Counter("isodyn_problems", "Refusals by the type of their problem document.", ("type",))
AUTH_FAILURES = Counter(
    "isodyn_auth_failures", "Requests without a good key: missing, unknown, forbidden.", ("reason",)
)

LOCATE_SECONDS = Histogram("isodyn_locate_seconds", "Time to a fix, with waiting.", buckets=_QUICK_S)
LOCATE_WAITING_SECONDS = Histogram("isodyn_locate_waiting_seconds", "Time a window waits its turn.", buckets=_QUICK_S)
LOCATE_SEARCH_SECONDS = Histogram("isodyn_locate_search_seconds", "Time to search the maps.", buckets=_QUICK_S)
LOCATE_FLOORS = Histogram("isodyn_locate_floors", "Floors searched for a window.", buckets=(0, 1, 2, 5, 10, 20, 50))
LOCATE_FIXES = Counter("isodyn_locate_fixes", "Windows answered, by status of the fix.", ("status",))
LOCATE_ESTIMATES = Counter(
    "isodyn_locate_estimates", "Estimates asked for, by technique, and whether it had one.", ("technique", "available")
)

TRACK_STEPS = Counter("isodyn_track_steps", "Steps of tracks: accepted, duplicates, late.", ("outcome",))
TRACK_BATCH_SECONDS = Histogram(
    "isodyn_track_batch_seconds", "Time from a batch's arrival until it is stored and answered.", buckets=_QUICK_S
)

UPLOADS = Counter("isodyn_uploads", "Surveys uploaded: new, known, refused.", ("outcome",))
UPLOAD_BYTES = Histogram("isodyn_upload_bytes", "Size of an uploaded survey, unpacked.", buckets=_SIZES)
UPLOAD_PARSE_SECONDS = Histogram("isodyn_upload_parse_seconds", "Time to read, check and store a survey.")

MAP_CACHE_LOOKUPS = Counter("isodyn_map_cache_lookups", "Maps wanted: hit, miss.", ("result",))
MAP_CACHE_LOAD_SECONDS = Histogram("isodyn_map_cache_load_seconds", "Time to load and prepare what was not held.")
MAP_CACHE_EVICTIONS = Counter("isodyn_map_cache_evictions", "Maps dropped to make room.")
MAP_CACHE_BYTES = Gauge("isodyn_map_cache_bytes", "Memory of maps held ready to answer.")

BLOB_SECONDS = Histogram("isodyn_blob_seconds", "Time of an operation of the blob store.", ("operation",))
BLOB_ERRORS = Counter("isodyn_blob_errors", "Operations of the blob store that failed.", ("operation",))

JOBS_ENDED = Counter("isodyn_jobs_ended", "Jobs that ended in this worker.", ("kind", "outcome"))
JOB_STEP_SECONDS = Histogram("isodyn_job_step_seconds", "Time of a step of a job.", ("step",), buckets=_LONG_S)
WORKERS_TAKEN_OVER = Counter("isodyn_workers_taken_over", "Workers that died or lost their lease, found by this one.")
