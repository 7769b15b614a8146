"""Receive a survey: parse it now, keep its bytes, and in one transaction its row and the floor's rebuild.

Order of durability: blobs are on disk before the row that names them, the row before the answer. A crash leaves at
worst a blob nobody names.
"""

from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.db.tables import Floor, Job, Survey
from app.field.samples import SampleFrame
from app.jobs.queue import JobQueue, lock_floor
from app.services.artefacts import samples_to_bytes
from app.survey.read import read_survey
from app.survey.walk import Walk

__all__ = ["ParsedSurvey", "parse_survey", "record_survey"]

DEVICE_HEIGHT_FORMATS = frozenset({"indoor-location-2020"})  # their z is height above the slab, not building z


@dataclass(frozen=True, slots=True)
class ParsedSurvey:
    """A survey whose bytes are safely stored, ready to become a row."""

    format: str
    frame: SampleFrame
    name: str
    raw_sha256: str
    samples_sha256: str
    sample_count: int
    report: dict[str, object]


def parse_survey(
    blobs: BlobStore, data: bytes, *, format: str, frame: SampleFrame, name: str, elevation_m: float
) -> ParsedSurvey:
    """Read a survey file and store its bytes and its samples. Raises UnreadableSurvey; then nothing is stored."""
    walk = read_survey(data, format=format, frame=frame)
    samples = _raise_to_floor(walk, elevation_m).samples if format in DEVICE_HEIGHT_FORMATS else walk.samples
    return ParsedSurvey(
        format=format,
        frame=samples.frame,
        name=name,
        raw_sha256=blobs.put(data),
        samples_sha256=blobs.put(samples_to_bytes(samples)),
        sample_count=len(samples),
        report=walk.report,
    )


def record_survey(
    session: Session, queue: JobQueue, floor: Floor, parsed: ParsedSurvey
) -> tuple[Survey, Job | None, bool]:
    """The survey's row, the rebuild it set off (None when the floor does not build by itself), and whether it is new.

    The same bytes in the same format and frame on the same floor are the same survey; `floor` is locked first, so
    that two uploads at once agree on which came first.
    """
    lock_floor(session, floor.id)
    same = select(Survey).where(
        Survey.floor_id == floor.id,
        Survey.raw_sha256 == parsed.raw_sha256,
        Survey.format == parsed.format,
        Survey.frame == parsed.frame,
    )
    existing = session.scalars(same).one_or_none()
    if existing is not None:
        return existing, latest_job(session, floor.id), False
    survey = Survey(
        organisation_id=floor.organisation_id,
        floor_id=floor.id,
        name=parsed.name,
        format=parsed.format,
        frame=parsed.frame,
        raw_sha256=parsed.raw_sha256,
        samples_sha256=parsed.samples_sha256,
        sample_count=parsed.sample_count,
        report=parsed.report,
    )
    session.add(survey)
    session.flush()
    return survey, queue.enqueue_rebuild(session, floor) if floor.auto_build else None, True


def latest_job(session: Session, floor_id: str) -> Job | None:
    """The floor's most recent job."""
    return session.scalars(select(Job).where(Job.floor_id == floor_id).order_by(Job.id.desc()).limit(1)).first()


def _raise_to_floor(walk: Walk, elevation_m: float) -> Walk:
    lifted = walk.samples.p_building_m + np.array([0.0, 0.0, elevation_m])
    return replace(walk, samples=replace(walk.samples, p_building_m=lifted))
