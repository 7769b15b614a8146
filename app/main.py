"""The composition root of the web process: settings in, one FastAPI application out."""

import asyncio
import gc
import logging
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from threading import Thread
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from fastapi.middleware.cors import CORSMiddleware
from fastapi.responses import RedirectResponse
from threadpoolctl import threadpool_limits

from app import __version__
from app.api import (
    attitudes,
    audit,
    buildings,
    calibrations,
    contract_page,
    floors,
    health,
    jobs,
    keys,
    localizability,
    locate,
    maps,
    metrics,
    outlines,
    plans,
    reference_field,
    replay,
    surveys,
    track_stream,
    tracks,
)
from app.api.access_log import AccessLog
from app.api.admission import Admission, BodyMemory
from app.api.body import BodyLimit
from app.api.context import Context
from app.api.entity_tags import EntityTags
from app.api.headers import SecurityHeaders
from app.api.key_limits import KeyLimits, KeyLimitsMiddleware
from app.api.problems import Problem, add_problem_handlers
from app.api.upkeep import BACKGROUND, note_uses_last
from app.blobs import open_blob_store
from app.db.engine import create_database_engine, migrate, session_factory
from app.jobs.queue import JobQueue
from app.positioning.locate import warm_up
from app.services.file_readers import FileReaders
from app.services.follow import Follower
from app.services.follow_warm_up import warm_up_tracks
from app.services.grid_cache import GridCache
from app.services.key_ring import KeyRing
from app.services.manage_keys import ensure_admin_key
from app.services.quotas import Quotas
from app.services.step_rate import StepRate
from app.services.track_spec import Trackers
from app.services.turns import Turns
from app.settings import Settings
from app.viewer.database_source import DatabaseViewerSource
from app.viewer.page import ViewerApp

if TYPE_CHECKING:
    from app.api.bearer_tokens import BearerTokens

__all__ = ["create_app", "first_start", "open_context"]

_log = logging.getLogger(__name__)

DESCRIPTION = """Magnetic maps of buildings: upload walks, get a field map per floor, locate a window of
magnetometer samples. Lengths are metres, field microtesla, angles radians, times UTC; every estimate says how sure it
is. Errors are RFC 9457 problem documents. Every answer names its request in
`X-Request-ID`: yours, or one made for it."""


MOST_SEARCHES = 4  # at once: a search holds Python's one lock part of its time, so that more only wait for each other
LOOK_UPS = 8  # of keys at once: a known key is remembered, so that there are few


def first_start(settings: Settings) -> str | None:
    """Make the data folder, bring the database to today's schema and see to an admin key.

    Returns the key when one was made that nobody has seen: show it, it is not kept.
    """
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    engine = create_database_engine(settings.resolved_database_url)
    migrate(engine)
    with session_factory(engine).begin() as session:
        made = ensure_admin_key(session, settings.admin_key)
    engine.dispose()
    return made


def open_context(settings: Settings) -> Context:
    """Open the database, the blob store and the job queue of a web process."""
    engine = create_database_engine(settings.resolved_database_url)
    blobs = open_blob_store(settings.resolved_blob_url)
    sessions = session_factory(engine)
    tokens = None if settings.oidc_issuer is None else _open_tokens(settings)
    grids = GridCache(blobs, settings.grid_cache_bytes)
    threads = min(os.cpu_count() or 1, MOST_SEARCHES)
    follows = Turns(threads, "follow", settings.max_wait_s, patient=True)
    return Context(
        settings=settings,
        engine=engine,
        sessions=sessions,
        blobs=blobs,
        queue=JobQueue(engine),
        files=FileReaders(settings.parse_processes, settings.parse_memory_bytes, settings.parse_seconds),
        grids=grids,
        keys=KeyRing(sessions, tokens),
        look_ups=Turns(LOOK_UPS, "key", settings.max_wait_s),
        tokens=tokens,
        key_limits=KeyLimits(settings.max_requests_per_s, settings.max_requests_per_key, settings.max_streams_per_key),
        quotas=Quotas(
            buildings=settings.max_buildings,
            floors_per_building=settings.max_floors_per_building,
            surveys=settings.max_surveys,
            surveys_per_floor=settings.max_surveys_per_floor,
            survey_bytes=settings.max_survey_bytes,
            keys=settings.max_keys,
        ),
        bodies=BodyMemory(settings.body_memory_bytes - settings.body_memory_bytes // 4, settings.max_wait_s),
        searches=Turns(threads, "search", settings.max_wait_s, patient=True),
        follows=follows,
        uploads=Turns(settings.parse_processes, "upload", settings.max_upload_wait_s),
        follower=Follower(
            engine,
            sessions,
            Trackers(grids),
            follows,
            idle_timeout_s=settings.track_idle_timeout_s,
            capacity_bytes=settings.track_cache_bytes,
        ),
        step_rate=StepRate(settings.max_track_steps_per_s),
    )


def _open_tokens(settings: Settings) -> "BearerTokens":
    # Takes a quarter of a second, and few installations need it.
    from app.api.bearer_tokens import BearerTokens

    return BearerTokens(settings)


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application. `first_start` must have run on these settings."""
    settings = settings or Settings()
    threadpool_limits(1)  # a query's matrices are small: more BLAS threads make it slower, and starve the others

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        Thread(target=_get_ready, args=(context,), name="warm-up", daemon=True).start()
        tasks = [asyncio.create_task(work(context)) for work in BACKGROUND]
        yield
        for task in tasks:
            task.cancel()
        await run_in_threadpool(note_uses_last, context)
        await viewer.close()
        await run_in_threadpool(context.follower.close)
        await run_in_threadpool(context.files.close)
        await run_in_threadpool(context.queue.close)
        context.engine.dispose()

    context = open_context(settings)
    app = FastAPI(title="Isodyn", version=__version__, description=DESCRIPTION, lifespan=lifespan,
                  redirect_slashes=False, docs_url=None, redoc_url=None,
                  # AccessLog makes the span of a request: FastAPI's would tell queries and clients' addresses.
                  telemetry={"tracing": False, "metrics": False, "logs": False})  # fmt: skip
    app.state.context = context
    # `locate` first: routes are tried in order, and a position is asked for far more often than anything else.
    for part in (
        locate,
        tracks,
        track_stream,
        health,
        metrics,
        buildings,
        floors,
        outlines,
        plans,
        surveys,
        maps,
        localizability,
        replay,
        reference_field,
        calibrations,
        attitudes,
        jobs,
        keys,
        audit,
        contract_page,
    ):
        app.include_router(part.router)
    for path in ("/", "/view"):
        app.add_api_route(path, _to_the_page, include_in_schema=False)
    viewer = ViewerApp(context.keys.recognise, DatabaseViewerSource(context.sessions, context.blobs), api=app)
    app.mount("/view", viewer)
    add_problem_handlers(app)
    # The last one added sees a request first.
    app.add_middleware(KeyLimitsMiddleware, limits=context.key_limits)
    app.add_middleware(Admission, most=settings.max_requests)
    # Before a request counts as open: nobody knows yet whose it is, and a body may come slowly. Its memory is not that
    # of uploads, which say whose they are before they are read.
    bodies = BodyMemory(settings.body_memory_bytes // 4, settings.max_wait_s)
    app.add_middleware(BodyLimit, max_bytes=settings.max_body_bytes, memory=bodies, streams_itself=_is_upload)
    app.add_middleware(EntityTags)
    app.add_middleware(SecurityHeaders, hsts_s=settings.hsts_s)
    if settings.cors_origins:
        app.add_middleware(CORSMiddleware, **_cross_origin(settings.cors_origins))
    app.add_middleware(AccessLog)
    _describe_problems(app)
    return app


def _get_ready(context: Context) -> None:
    """Warm up, then have nobody wait too long, and let the garbage collector forget all that is there by now.

    These objects (modules, compiled kernels, the application) stay as long as the process. To look through them stops
    every thread for more than 0.1 s, and a busy server would do so about once a second.
    """
    warm_up()
    context.searches.hurry()
    warm_up_tracks()
    context.follows.hurry()
    gc.collect()
    gc.freeze()


def _to_the_page() -> RedirectResponse:
    return RedirectResponse("/view/")


def _cross_origin(origins: str) -> dict[str, Any]:
    """For browser clients elsewhere: their keys go in a header, so that no cookie is let in."""
    return {
        "allow_origins": [origin.strip() for origin in origins.split(",") if origin.strip()],
        "allow_methods": ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"],
        "allow_headers": [
            "Authorization",
            "Content-Encoding",
            "Content-Type",
            "Idempotency-Key",
            "If-Match",
            "If-None-Match",
            "X-Request-ID",
        ],
        "expose_headers": ["ETag", "Link", "RateLimit", "RateLimit-Policy", "Retry-After", "X-Request-ID"],
    }


def _is_upload(path: str) -> bool:
    """Whether an upload comes here, straight or by the page."""
    path = path.removeprefix("/view")
    return path.startswith("/v1/floors/") and path.endswith(("/surveys", "/plan", "/replay"))


def _describe_problems(app: FastAPI) -> None:
    """Put the problem document into the OpenAPI schema, which refers to it from every operation."""
    make = app.openapi

    def openapi() -> dict[str, object]:
        schema = make()
        problem = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        definitions = problem.pop("$defs")
        schema["components"]["schemas"].update({"Problem": problem, **definitions})
        return schema

    app.openapi = openapi  # type: ignore[method-assign]
