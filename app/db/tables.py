"""The tables: organisation, key, audit, building, floor, calibration, survey, map, job, track; worker, tile chunk
and idempotency.

Ids are UUIDv7 strings, so they sort by creation. Times are UTC. Every row that a key may reach carries its
organisation. `migrations/` holds the same schema as history; a test compares the two.
"""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    ForeignKey,
    Index,
    LargeBinary,
    MetaData,
    SmallInteger,
    String,
    UniqueConstraint,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.types import TypeDecorator
from uuid6 import uuid7

__all__ = [
    "Audit",
    "BUILD",
    "Base",
    "Building",
    "Calibration",
    "Floor",
    "Idempotency",
    "Job",
    "Key",
    "Map",
    "Organisation",
    "REBUILD",
    "Survey",
    "TileChunk",
    "Track",
    "TrackState",
    "TrackSteps",
    "Worker",
    "new_id",
]

BUILD, REBUILD = "build", "rebuild"
"""Kinds of jobs: a map that somebody asked for, and a floor's next one after its surveys changed."""


def new_id() -> str:
    """A new UUIDv7: opaque to callers, sortable by time."""
    return str(uuid7())


def utc_now() -> datetime:
    return datetime.now(UTC)


class UtcDateTime(TypeDecorator[datetime]):
    """Aware UTC datetimes, also on SQLite, which forgets zones."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        return None if value is None else (value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC))


class Base(DeclarativeBase):
    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {datetime: UtcDateTime, dict[str, Any]: JSON, list[str]: JSON, list[float]: JSON}  # noqa: RUF012


Id = String(36)
Sha256 = String(64)


class Organisation(Base):
    __tablename__ = "organisation"
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200), unique=True)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Key(Base):
    """An API key. Only its SHA-256 is kept: the key itself is shown once.

    `building_ids`: all that it sees and touches; null is everything of the organisation. `last_used_at` is a minute
    behind. With `issuer` and `subject` it stands for somebody an identity provider vouches for: then `sha256` is that
    of nothing, and scopes and buildings are those of each token."""

    __tablename__ = "key"
    __table_args__ = (
        Index("ix_key_organisation_id_issuer_subject", "organisation_id", "issuer", "subject", unique=True),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"), index=True)
    name: Mapped[str] = mapped_column(String(200))
    sha256: Mapped[str] = mapped_column(Sha256, unique=True)
    scopes: Mapped[list[str]]
    building_ids: Mapped[list[str] | None] = mapped_column(JSON(none_as_null=True))
    issuer: Mapped[str | None] = mapped_column(String(300))
    subject: Mapped[str | None] = mapped_column(String(255))
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]


class Audit(Base):
    """What was done, by whom: a row a change, written in its transaction and never changed (`app.services.audit_log`).

    `action` is the kind of object and what became of it, as in `survey.upload`. `outcome`: done, accepted (a job does
    the rest). `key_id` is null for the command line; keys and objects are named, not referred to: the log outlives
    them."""

    __tablename__ = "audit"
    __table_args__ = (
        Index("ix_audit_organisation_id_id", "organisation_id", "id"),
        Index("ix_audit_organisation_id_key_id_id", "organisation_id", "key_id", "id"),
        Index("ix_audit_organisation_id_action_id", "organisation_id", "action", "id"),
        Index("ix_audit_object_id", "object_id"),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    at: Mapped[datetime] = mapped_column(default=utc_now, index=True)
    key_id: Mapped[str | None] = mapped_column(Id)
    actor: Mapped[str] = mapped_column(String(300))
    action: Mapped[str] = mapped_column(String(60))
    object_id: Mapped[str] = mapped_column(Id)
    outcome: Mapped[str] = mapped_column(String(20))
    address: Mapped[str | None] = mapped_column(String(60))
    request_id: Mapped[str | None] = mapped_column(String(128))
    details: Mapped[dict[str, Any]]


class Building(Base):
    __tablename__ = "building"
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"), index=True)
    name: Mapped[str] = mapped_column(String(200))
    anchor: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Floor(Base):
    """`claimed_generation` names rebuilds (docs/decisions/0003); `build_sequence` orders builds as they start;
    `active_sequence` is the sequence of the build that `active_map_id` points to, so an older build never replaces a
    newer one. `plan` is a picture in the blob store and where it lies (`app.services.receive_plan.Plan`)."""

    __tablename__ = "floor"
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    building_id: Mapped[str] = mapped_column(ForeignKey("building.id"), index=True)
    name: Mapped[str] = mapped_column(String(200))
    ordinal: Mapped[int]
    elevation_m: Mapped[float]
    height_m: Mapped[float | None]
    outline: Mapped[dict[str, Any] | None]
    plan: Mapped[dict[str, Any] | None]
    auto_build: Mapped[bool] = mapped_column(default=True)
    claimed_generation: Mapped[int] = mapped_column(default=0)
    build_sequence: Mapped[int] = mapped_column(default=0)
    active_map_id: Mapped[str | None] = mapped_column(Id)
    active_sequence: Mapped[int] = mapped_column(default=0)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Calibration(Base):
    """A device's calibration, which never changes: a later one is another row, of the next `version`.

    `model` is what is applied, `fit` all that is known of it, `reference` what it was measured against (as JSON);
    `samples_sha256` the readings it was made from, in the blob store."""

    __tablename__ = "calibration"
    __table_args__ = (
        UniqueConstraint("organisation_id", "device", "version"),
        Index("ix_calibration_organisation_id_id", "organisation_id", "id"),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    device: Mapped[str] = mapped_column(String(200))
    version: Mapped[int]
    method: Mapped[str] = mapped_column(String(40))
    model: Mapped[dict[str, Any]]
    fit: Mapped[dict[str, Any]]
    reference: Mapped[dict[str, Any]]
    samples_sha256: Mapped[str] = mapped_column(Sha256)
    measured_at: Mapped[datetime]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Survey(Base):
    """`calibration_id`: that of the device which walked it, applied to its samples as they came in. `excluded_s`:
    stretches of its time that no map is built from, [[start, end], ...], or null."""

    __tablename__ = "survey"
    __table_args__ = (
        UniqueConstraint("floor_id", "raw_sha256", "format", "frame"),
        Index("ix_survey_organisation_id_raw_bytes", "organisation_id", "raw_bytes"),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    floor_id: Mapped[str] = mapped_column(ForeignKey("floor.id"), index=True)
    name: Mapped[str] = mapped_column(String(200))
    format: Mapped[str] = mapped_column(String(40))
    frame: Mapped[str] = mapped_column(String(20))
    raw_sha256: Mapped[str] = mapped_column(Sha256)
    raw_bytes: Mapped[int | None] = mapped_column(BigInteger)
    samples_sha256: Mapped[str] = mapped_column(Sha256)
    sample_count: Mapped[int]
    report: Mapped[dict[str, Any]]
    included: Mapped[bool] = mapped_column(default=True)
    calibration_id: Mapped[str | None] = mapped_column(ForeignKey("calibration.id"))
    excluded_s: Mapped[list[list[float]] | None] = mapped_column(JSON(none_as_null=True))
    created_at: Mapped[datetime] = mapped_column(default=utc_now)


class Map(Base):
    """`status`: accepted, running, ready, failed, dismissed. `spec` is the request; grid, layers and quality are blobs.

    `state_sha256` is a cache: what the next build may start from instead of every sample."""

    __tablename__ = "map"
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    floor_id: Mapped[str] = mapped_column(ForeignKey("floor.id"), index=True)
    status: Mapped[str] = mapped_column(String(20))
    sequence: Mapped[int] = mapped_column(default=0)
    activate: Mapped[bool] = mapped_column(default=True)
    spec: Mapped[dict[str, Any]]
    survey_ids: Mapped[list[str]]
    components: Mapped[str | None] = mapped_column(String(20))
    grid_sha256: Mapped[str | None] = mapped_column(Sha256)
    layers_sha256: Mapped[str | None] = mapped_column(Sha256)
    quality_sha256: Mapped[str | None] = mapped_column(Sha256)
    state_sha256: Mapped[str | None] = mapped_column(Sha256)
    bounds_m: Mapped[list[float] | None]
    hyperparameters: Mapped[dict[str, Any] | None]
    score: Mapped[dict[str, Any] | None]
    score_reason: Mapped[str | None]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    finished_at: Mapped[datetime | None]


class Job(Base):
    """What a user sees of background work. `workflow_id` names it in the engine: one row per workflow.

    `status`: accepted, running, successful, failed, dismissed (OGC API Processes). `priority`: 1, 2 or 3, the first
    served first; `admitted_at`: when the job was handed to the engine (`app.jobs.admission`). `fencing_token`: whose
    try at it counts; `plan`: what the first try was to build, while it runs. `request_id` and `traceparent` are of the
    request that asked for it first, for the log and for traces."""

    __tablename__ = "job"
    __table_args__ = (
        Index("ix_job_organisation_id_id", "organisation_id", "id"),
        Index("ix_job_organisation_id_admitted_at", "organisation_id", "admitted_at"),
        Index("ix_job_status_floor_id", "status", "floor_id"),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    floor_id: Mapped[str] = mapped_column(Id)
    map_id: Mapped[str | None] = mapped_column(Id)
    kind: Mapped[str] = mapped_column(String(40))
    workflow_id: Mapped[str] = mapped_column(String(120), unique=True)
    priority: Mapped[int] = mapped_column(SmallInteger, default=2, server_default="2")
    admitted_at: Mapped[datetime | None]
    status: Mapped[str] = mapped_column(String(20), default="accepted")
    progress: Mapped[int] = mapped_column(default=0)
    message: Mapped[str] = mapped_column(default="waiting for a worker")
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    fencing_token: Mapped[str | None] = mapped_column(Id)
    plan: Mapped[dict[str, Any] | None] = mapped_column(deferred=True)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    result: Mapped[dict[str, Any] | None]
    request_id: Mapped[str | None] = mapped_column(String(64))
    traceparent: Mapped[str | None] = mapped_column(String(55))


class Track(Base):
    """`status`: active, ended. `spec` is what it is followed by, pinned when it was made: floors with their maps,
    options, prior and ground (`app.services.track_spec`). `version` grows with every write, so that whoever followed
    from an older one is noticed. `waiting` are steps that came before one that is missing, `gaps` numbers that were
    given up: [first, stop). `ended_reason`: idle, asked."""

    __tablename__ = "track"
    __table_args__ = (
        Index("ix_track_organisation_id_id", "organisation_id", "id"),
        Index("ix_track_key_id_status", "key_id", "status"),
        Index("ix_track_status_touched_at", "status", "touched_at"),
    )
    id: Mapped[str] = mapped_column(Id, primary_key=True, default=new_id)
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"))
    key_id: Mapped[str] = mapped_column(ForeignKey("key.id"))
    building_id: Mapped[str] = mapped_column(ForeignKey("building.id"), index=True)
    name: Mapped[str | None] = mapped_column(String(200))
    status: Mapped[str] = mapped_column(String(20), default="active")
    ended_reason: Mapped[str | None] = mapped_column(String(20))
    frame: Mapped[str] = mapped_column(String(20))
    seed: Mapped[int] = mapped_column(BigInteger)
    spec: Mapped[dict[str, Any]]
    version: Mapped[int] = mapped_column(default=0)
    batches: Mapped[int] = mapped_column(default=0)
    next_step: Mapped[int] = mapped_column(BigInteger, default=0)
    waiting: Mapped[list[dict[str, Any]]] = mapped_column(JSON, default=list)
    gaps: Mapped[list[list[int]]] = mapped_column(JSON, default=list)
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
    touched_at: Mapped[datetime] = mapped_column(default=utc_now)
    ended_at: Mapped[datetime | None]


class TrackSteps(Base):
    """Steps as they were followed, a batch a row, in order: `sequence` counts the track's batches from zero.

    `data` is compressed JSON: the steps, the estimate that was answered, and the path (`app.services.track_log`).
    `settled` are the places that were smoothed for good; `sha256` is that of all the batch said."""

    __tablename__ = "track_steps"
    track_id: Mapped[str] = mapped_column(ForeignKey("track.id"), primary_key=True)
    sequence: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    next_step: Mapped[int] = mapped_column(BigInteger)
    data: Mapped[bytes] = mapped_column(LargeBinary)
    settled: Mapped[list[Any] | None] = mapped_column(JSON(none_as_null=True))
    sha256: Mapped[str] = mapped_column(Sha256)


class TrackState(Base):
    """A cache: the state after the first `batches` batches, so that a restart follows only what came after."""

    __tablename__ = "track_state"
    track_id: Mapped[str] = mapped_column(ForeignKey("track.id"), primary_key=True)
    batches: Mapped[int]
    written_by: Mapped[str] = mapped_column(String(40))
    data: Mapped[bytes] = mapped_column(LargeBinary)


class Worker(Base):
    """The lease of a worker process (docs/decisions/0003): `beat` is the database's clock, `state` live or dead;
    `slots` are the jobs it runs at one time, null for a version that admits none (docs/decisions/0016)."""

    __tablename__ = "worker"
    id: Mapped[str] = mapped_column(String(120), primary_key=True)
    state: Mapped[str] = mapped_column(String(10))
    beat: Mapped[datetime]
    reaper: Mapped[str | None] = mapped_column(String(120))
    slots: Mapped[int | None]


class TileChunk(Base):
    """Some tiles of a floor whose fit workers share (docs/decisions/0017). `order_sha256` says what to fit, for
    programs of this `version`; `taken_by` is a worker or whoever builds the map, `fits_sha256` what was brought."""

    __tablename__ = "tile_chunk"
    offer_id: Mapped[str] = mapped_column(Id, primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    job_id: Mapped[str] = mapped_column(Id)
    order_sha256: Mapped[str] = mapped_column(Sha256)
    version: Mapped[str] = mapped_column(String(40))
    taken_by: Mapped[str | None] = mapped_column(String(120))
    fits_sha256: Mapped[str | None] = mapped_column(Sha256)


class Idempotency(Base):
    """The answer once given to a request with an Idempotency-Key, to be given again."""

    __tablename__ = "idempotency"
    organisation_id: Mapped[str] = mapped_column(ForeignKey("organisation.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(Sha256)
    status_code: Mapped[int]
    body: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=utc_now)
