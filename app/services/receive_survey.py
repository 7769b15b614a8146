"""Receive a survey: parse it now, keep its bytes, and in one transaction its row and the floor's rebuild.

Order of durability: blobs are on disk before the row that names them, the row before the answer. A crash leaves at
worst a blob nobody names.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from math import degrees

from sqlalchemy import and_, or_, select
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.db.tables import Floor, Job, Survey
from app.earth_field import earth_field, field_in_building_uT
from app.errors import Conflict, Fault, InvalidInput, NotFound
from app.field.samples import SampleFrame
from app.geodesy import Anchor
from app.jobs.queue import JobQueue, lock_floor
from app.services.artefacts import samples_to_bytes
from app.services.calibrations import AppliedCalibration
from app.services.disturbances import by_itself
from app.services.file_orders import SurveyOrder, read_on_floor
from app.survey.earth_check import check_against_earth
from app.survey.walk import Walk

__all__ = ["ParsedSurvey", "find_replaced", "parse_survey", "record_survey", "was_replaced"]


@dataclass(frozen=True, slots=True)
class ParsedSurvey:
    """A survey whose bytes are safely stored, ready to become a row."""

    format: str
    frame: SampleFrame
    name: str
    raw_sha256: str
    raw_bytes: int
    samples_sha256: str
    sample_count: int
    report: dict[str, object]
    session: str | None
    elevation_m: float
    calibration_id: str | None = None


def parse_survey(
    blobs: BlobStore,
    data: bytes,
    *,
    format: str,
    frame: SampleFrame,
    name: str,
    elevation_m: float,
    session: str | None = None,
    calibration: AppliedCalibration | None = None,
    at: tuple[Anchor, date] | None = None,
    read: Callable[[SurveyOrder], Walk] = read_on_floor,
) -> ParsedSurvey:
    """Read a survey file and store its bytes and its samples. Raises UnreadableSurvey; then nothing is stored.

    The device's `calibration` is applied to its readings; surveys of one calibration share a session, unless it is
    told. `at` an anchor and a date the walk is checked against the Earth's field. `read` says where the file is read.
    """
    if calibration is not None and session is None:
        session = calibration.label
    walk = read(
        SurveyOrder(data, format, frame, elevation_m, session, None if calibration is None else calibration.model)
    )
    samples = walk.samples
    told = _told_calibration(calibration) | _earth_check(walk, at)
    report = walk.report | told | {"disturbances": by_itself(samples)}
    return ParsedSurvey(
        format=format,
        frame=samples.frame,
        name=name,
        raw_sha256=blobs.put(data),
        raw_bytes=len(data),
        samples_sha256=blobs.put(samples_to_bytes(samples)),
        sample_count=len(samples),
        report=report,
        session=session,
        elevation_m=elevation_m,
        calibration_id=None if calibration is None else calibration.id,
    )


def _told_calibration(calibration: AppliedCalibration | None) -> dict[str, object]:
    return {"calibration": None if calibration is None else calibration.told}


def _earth_check(walk: Walk, at: tuple[Anchor, date] | None) -> dict[str, object]:
    """How the walk compares with the Earth's field, and its findings among the warnings."""
    if at is None:
        return {"reference_field": None}
    anchor, on = at
    field = earth_field(anchor.latitude_deg, anchor.longitude_deg, anchor.height_m, on)
    check = check_against_earth(walk.samples, field_in_building_uT(field, anchor), bearing_known=True)
    warnings = walk.report["warnings"]
    assert isinstance(warnings, list)
    if not field.valid:
        warnings.append(f"{field.model} ended on {field.valid_until}: the Earth's field is carried on from it")
    return {
        "warnings": [*warnings, *check.findings],
        "reference_field": {
            "model": field.model,
            "date": on.isoformat(),
            "magnitude_ut": round(check.earth_magnitude_uT, 3),
            "inclination_deg": round(degrees(check.earth_inclination_rad), 2),
            "measured_magnitude_ut": round(check.magnitude_uT, 3),
            "measured_inclination_deg": (
                None if check.inclination_rad is None else round(degrees(check.inclination_rad), 2)
            ),
            "findings": list(check.findings),
        },
    }


def record_survey(
    session: Session, queue: JobQueue, floor: Floor, parsed: ParsedSurvey, replaces: str | None = None
) -> tuple[Survey, Job | None, bool]:
    """The survey's row, the rebuild it set off (None when the floor does not build by itself), and whether it is new.

    The same bytes in the same format and frame, or equal samples, on the same floor are the same survey; `floor` is
    locked first, so that two uploads at once agree on which came first. One left out of maps stays so, and has no job.
    `replaces`: the survey that goes as this one comes; said again once done, it changes nothing.
    Raises NotFound, InvalidInput (`find_replaced`), Conflict.
    """
    lock_floor(session, floor.id)
    session.refresh(floor, ["elevation_m"])
    if floor.elevation_m != parsed.elevation_m:
        raise Conflict("the floor's elevation was changed while the survey was read; send it again")
    same = _same_survey(session, floor.id, parsed, replaces)
    if same is not None and replaces in (None, same.id, same.report.get("replaces")):
        _check_session(same, parsed)
        return same, latest_job(session, floor.id) if same.included else None, False
    old = find_replaced(session, floor, replaces) if replaces else None
    if same is not None:
        raise Conflict(f"these samples are survey {same.id} already; delete {replaces} instead of replacing it")
    if old is not None:
        session.delete(old)
        session.flush()
    survey = _new_survey(floor, parsed, replaces)
    session.add(survey)
    session.flush()
    return survey, queue.enqueue_rebuild(session, floor) if floor.auto_build else None, True


def find_replaced(session: Session, floor: Floor, survey_id: str) -> Survey:
    """The survey to be replaced. Raises NotFound, or InvalidInput when it is of another floor."""
    old = session.get(Survey, survey_id)
    if old is None or old.organisation_id != floor.organisation_id:
        raise NotFound(f"no survey {survey_id} to replace")
    if old.floor_id != floor.id:
        reason = f"survey {survey_id} is of another floor, {old.floor_id}"
        raise InvalidInput(reason, Fault("/query/replaces", reason))
    return old


def was_replaced(session: Session, floor: Floor, survey_id: str) -> bool:
    """Whether a survey of the floor took the place of this one."""
    came = Survey.report["replaces"].as_string() == survey_id
    return session.scalars(select(Survey.id).where(Survey.floor_id == floor.id, came).limit(1)).first() is not None


def _same_survey(session: Session, floor_id: str, parsed: ParsedSurvey, replaces: str | None) -> Survey | None:
    """The first survey of the same samples, else of the same bytes; one of other samples that is to go is none."""
    same_bytes = and_(
        Survey.raw_sha256 == parsed.raw_sha256, Survey.format == parsed.format, Survey.frame == parsed.frame
    )
    same_samples = Survey.samples_sha256 == parsed.samples_sha256
    same = select(Survey).where(Survey.floor_id == floor_id, or_(same_bytes, same_samples))
    staying = same.where(or_(Survey.id != replaces, same_samples)) if replaces else same
    return session.scalars(staying.order_by(Survey.samples_sha256 != parsed.samples_sha256, Survey.id).limit(1)).first()


def _check_session(same: Survey, parsed: ParsedSurvey) -> None:
    said, now = same.report.get("session"), parsed.session
    if same.calibration_id != parsed.calibration_id:
        before = f"calibration {same.calibration_id}" if same.calibration_id else "no calibration"
        raise Conflict(f"these bytes are survey {same.id} already, with {before}; give replaces={same.id}")
    if now not in (None, said):
        raise Conflict(f"these bytes are survey {same.id} already, of session {said}; give replaces={same.id}")


def _new_survey(floor: Floor, parsed: ParsedSurvey, replaces: str | None) -> Survey:
    return Survey(
        organisation_id=floor.organisation_id,
        floor_id=floor.id,
        name=parsed.name,
        format=parsed.format,
        frame=parsed.frame,
        raw_sha256=parsed.raw_sha256,
        raw_bytes=parsed.raw_bytes,
        samples_sha256=parsed.samples_sha256,
        sample_count=parsed.sample_count,
        report=parsed.report | {"replaces": replaces},
        calibration_id=parsed.calibration_id,
    )


def latest_job(session: Session, floor_id: str) -> Job | None:
    """The floor's most recent job."""
    return session.scalars(select(Job).where(Job.floor_id == floor_id).order_by(Job.id.desc()).limit(1)).first()
