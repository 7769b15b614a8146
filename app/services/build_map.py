"""Build the map of a floor from its surveys: claim what to build, fit it, publish it.

A worker calls the three in this order; each may run twice (a worker may die after the work and before the note of
it), so each is idempotent. Claiming draws the floor's next `build_sequence`; publishing moves the floor's pointer
only if nothing newer was published, so builds that overtake each other cannot bring an old map back.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.db.tables import REBUILD, Floor, Job, Map, Survey
from app.errors import CorruptArtefact, InvalidInput, NotFound
from app.field.fit import fit_map
from app.field.samples import SampleFrame, Samples, richest_components
from app.field.spec import FittedMap, MapSpec
from app.field.tile_fit import FitState, fit_one_by_one
from app.services.artefacts import grid_to_bytes, layers_to_bytes, samples_from_bytes
from app.services.disturbances import against_others, without_stretches
from app.services.exact_limit import TOO_MANY, outgrow_exact
from app.services.fit_state import Excluded, state_from_bytes, state_to_bytes
from app.services.shared_tiles import Board, fit_chunk, fit_with_others

__all__ = ["claim_build", "dismiss_build", "fail_build", "fit_build", "fit_chunk", "publish_build"]

Plan = dict[str, Any]
Result = dict[str, Any]


def claim_build(session: Session, job_id: str) -> Plan:
    """Mark the job running and fix what it builds: the surveys included now, the parameters, its place in order."""
    job = _job(session, job_id)
    now = datetime.now(UTC)
    map_row = session.get(Map, job.map_id) if job.map_id else None
    if map_row is None:  # a rebuild makes its map row when it starts
        map_row = Map(organisation_id=job.organisation_id, floor_id=job.floor_id, status="running",
                      spec=_active_spec(session, job.floor_id), survey_ids=[], created_at=now)  # fmt: skip
        session.add(map_row)
        session.flush()
        job.map_id = map_row.id
    if map_row.sequence == 0:
        map_row.sequence = session.execute(
            update(Floor)
            .where(Floor.id == job.floor_id)
            .values(build_sequence=Floor.build_sequence + 1)
            .returning(Floor.build_sequence)
        ).scalar_one()
        map_row.survey_ids = _wanted_surveys(session, job.floor_id, map_row)
    map_row.status = job.status = "running"
    job.started_at = job.started_at or now
    job.message = f"fitting {len(map_row.survey_ids)} surveys"
    surveys = session.execute(
        select(Survey.id, Survey.samples_sha256, Survey.frame, Survey.excluded_s).where(
            Survey.id.in_(map_row.survey_ids)
        )
    ).all()
    return {
        "map_id": map_row.id,
        "floor_id": job.floor_id,
        "sequence": map_row.sequence,
        "spec": map_row.spec,
        "rebuild": job.kind == REBUILD,
        "surveys": sorted([row.id, row.samples_sha256, row.frame] for row in surveys),
        "excluded_s": {row.id: row.excluded_s for row in surveys if row.excluded_s},
        **_earlier_states(session, job, map_row),
    }


def _earlier_states(session: Session, job: Job, map_row: Map) -> Plan:
    """`previous`: the newest map of the floor with these parameters, if its fit can be continued; a build that was

    asked for learns anew. `stale_states`: what earlier builds left and nobody will continue; their maps forget them.
    """
    kept = session.scalars(
        select(Map)
        .where(Map.floor_id == job.floor_id, Map.state_sha256.is_not(None), Map.id != map_row.id)
        .order_by(Map.sequence.desc())
    ).all()
    if not kept:
        return {"previous": None, "stale_states": []}
    newest, *older = kept
    left = {earlier.state_sha256 for earlier in older} - {newest.state_sha256}  # equal fits share a blob
    stale = sorted(sha256 for sha256 in left if sha256 is not None)
    for earlier in older:
        earlier.state_sha256 = None
    previous = {"state_sha256": newest.state_sha256, "components": newest.components, "survey_ids": newest.survey_ids}
    continued = job.kind == REBUILD and newest.spec == map_row.spec
    return {"previous": previous if continued else None, "stale_states": stale}


def fit_build(
    plan: Plan, blobs: BlobStore, progress: Callable[[float, str], None], board: Board | None = None
) -> Result:
    """Fit the map of a plan and store its grid, layers and quality reports as blobs. No database; may take minutes.

    Where there is a `board` others may help with the tiles of a large floor, by `fit_chunk`.

    A rebuild of what has outgrown engine `exact` is by the default engine; a build that was asked for is as asked.
    Raises InvalidInput (nothing to fit, frames that cannot give the components asked for), JobCancelled (through
    `progress`).
    """
    surveys: list[tuple[str, str, SampleFrame]] = [(i, sha, frame) for i, sha, frame in plan["surveys"]]
    if not surveys:
        raise InvalidInput("the floor has no included survey left to build a map from; upload or include one")
    progress(0.0, f"reading {len(surveys)} surveys")
    excluded: Excluded = plan.get("excluded_s", {})
    walks = {survey_id: samples_from_bytes(blobs.get(sha)) for survey_id, sha, _ in surveys}
    walks = {name: without_stretches(walk, excluded.get(name, [])) for name, walk in walks.items()}
    surveys, walks = _with_samples(surveys, walks)
    fallback = _fallback(plan, walks)
    spec = {name: value for name, value in plan["spec"].items() if name != "engine"} if fallback else plan["spec"]
    parameters = dict(spec)
    parameters.setdefault("components", richest_components({frame for _, _, frame in surveys}))
    if parameters.get("heights_m"):
        parameters["heights_m"] = tuple(parameters["heights_m"])
    previous = _previous_state(plan, parameters["components"], blobs)
    fitted = fit_map(
        walks,
        MapSpec(**parameters),
        lambda f, message: progress(0.02 + 0.93 * f, message),
        previous=previous,
        fit_tiles=fit_with_others(board, blobs) if board else fit_one_by_one,
    )
    progress(0.96, "storing the grid")
    for sha256 in plan.get("stale_states", []):
        blobs.discard(sha256)
    state = state_to_bytes(fitted.state, excluded) if fitted.state else None
    changes = _changes(plan, fitted) | {"fallback": fallback}
    return {
        "state_sha256": blobs.put(state) if state else None,
        "changes": changes,
        "spec": spec,
        "grid_sha256": blobs.put(grid_to_bytes(fitted.grid)),
        "layers_sha256": blobs.put(layers_to_bytes(fitted.layers)) if fitted.layers else None,
        "quality_sha256": blobs.put(_quality_bytes(fitted, changes, walks, excluded)),
        "components": fitted.grid.components,
        "bounds_m": list(fitted.grid.bounds_m),
        "hyperparameters": fitted.hyperparameters,
        "score": asdict(fitted.score) if fitted.score else None,
        "score_reason": fitted.score_reason,
    }


def _fallback(plan: Plan, walks: Mapping[str, Samples]) -> str | None:
    """Why a rebuild cannot be by the engine that was asked for."""
    if plan["spec"].get("engine") != "exact" or not plan.get("rebuild") or not outgrow_exact(walks.values()):
        return None
    return f"{TOO_MANY}: built by engine {MapSpec().engine}, as will be what follows"


def _with_samples(
    surveys: list[tuple[str, str, SampleFrame]], walks: Mapping[str, Samples]
) -> tuple[list[tuple[str, str, SampleFrame]], dict[str, Samples]]:
    """Without the surveys of which all, or all but one sample, is excluded. Raises InvalidInput when none is left."""
    left = {name: walk for name, walk in walks.items() if len(walk) > 1}
    if not left:
        raise InvalidInput("every sample of the floor's surveys is excluded; take some stretches in again")
    return [each for each in surveys if each[0] in left], left


def _disturbances(fitted: FittedMap, walks: Mapping[str, Samples]) -> dict[str, Any]:
    """Of every survey, where it departs from the map of the others."""
    grid = fitted.grid
    found = {
        name: against_others(walks[name], held_out, grid.components, grid.error_structure)
        for name, held_out in fitted.held_out.items()
        if held_out.judged.any()
    }
    return {name: stretches for name, stretches in found.items() if stretches}


def _previous_state(plan: Plan, components: str, blobs: BlobStore) -> FitState | None:
    """The fit to continue, if there is one that can be read."""
    previous = plan.get("previous")
    if not previous or previous["components"] != components:
        return None
    try:
        return state_from_bytes(blobs.get(previous["state_sha256"]), plan.get("excluded_s", {}))
    except (NotFound, CorruptArtefact):
        return None


def _changes(plan: Plan, fitted: FittedMap) -> Result:
    """What this build did beside the map before it."""
    now = {survey_id for survey_id, _, _ in plan["surveys"]}
    before = set(plan["previous"]["survey_ids"]) if fitted.continued else set()
    return {
        "hyperparameters": "kept" if fitted.continued else "learned",
        "surveys_added": sorted(now - before),
        "surveys_removed": sorted(before - now),
        "tiles_fitted": fitted.tiles_refitted if fitted.state else None,
        "tiles": len(fitted.state.tiles) if fitted.state else None,
    }


def publish_build(session: Session, job_id: str, plan: Plan, result: Result) -> None:
    """Make the map ready, move the floor's pointer to it unless a newer one is there, and end the job."""
    job = _job(session, job_id)
    map_row = session.get_one(Map, plan["map_id"])
    for name in ("grid_sha256", "quality_sha256", "components", "bounds_m", "hyperparameters", "score", "score_reason"):
        setattr(map_row, name, result[name])
    for name in ("layers_sha256", "state_sha256"):  # not every fit has them
        setattr(map_row, name, result.get(name))
    map_row.spec = result.get("spec", map_row.spec)
    map_row.status, map_row.finished_at = "ready", datetime.now(UTC)
    floor = session.get_one(Floor, plan["floor_id"], with_for_update=True)
    if map_row.activate and floor.active_sequence < plan["sequence"]:
        floor.active_map_id, floor.active_sequence = map_row.id, plan["sequence"]
    activated = floor.active_map_id == map_row.id
    overtaken = "; a newer map, or one chosen by hand, stays active" if map_row.activate else ""
    changes = result.get("changes") or {}
    fallback = f"; {changes['fallback']}" if changes.get("fallback") else ""
    _end(job, "successful", "the map is ready" + (" and active" if activated else overtaken) + fallback)
    job.progress = 100
    job.result = {
        "map_id": map_row.id, "sha256": map_row.grid_sha256, "activated": activated, "changes": changes,
    }  # fmt: skip


def fail_build(session: Session, job_id: str, message: str) -> None:
    """End the job and its map as failed, with a message a person can act on."""
    _end_unfinished(session, job_id, "failed", message)


def dismiss_build(session: Session, job_id: str) -> None:
    """End the job and its map as cancelled."""
    _end_unfinished(session, job_id, "dismissed", "cancelled")


def _end_unfinished(session: Session, job_id: str, status: str, message: str) -> None:
    job = _job(session, job_id)
    if job.status in ("successful", "failed", "dismissed"):
        return
    _end(job, status, message)
    map_row = session.get(Map, job.map_id) if job.map_id else None
    if map_row is not None:
        map_row.status, map_row.finished_at = status, datetime.now(UTC)


def _end(job: Job, status: str, message: str) -> None:
    job.status, job.message, job.finished_at = status, message, datetime.now(UTC)


def _job(session: Session, job_id: str) -> Job:
    job = session.get(Job, job_id, with_for_update=True)
    if job is None:
        raise NotFound(f"no job {job_id}")
    return job


def _active_spec(session: Session, floor_id: str) -> dict[str, Any]:
    """The parameters of the floor's active map: a rebuild keeps what somebody once asked for."""
    active = session.get_one(Floor, floor_id).active_map_id
    return dict(session.get_one(Map, active).spec) if active else {}


def _wanted_surveys(session: Session, floor_id: str, map_row: Map) -> list[str]:
    """The surveys asked for that still exist, or every included one."""
    wanted = select(Survey.id).where(Survey.floor_id == floor_id).order_by(Survey.id)
    wanted = wanted.where(Survey.id.in_(map_row.survey_ids)) if map_row.survey_ids else wanted.where(Survey.included)
    return list(session.scalars(wanted))


def _quality_bytes(fitted: FittedMap, changes: Result, walks: Mapping[str, Samples], excluded_s: Excluded) -> bytes:
    quality: Mapping[str, Any] = {
        "score": asdict(fitted.score) if fitted.score else None,
        "score_reason": fitted.score_reason,
        "components": fitted.grid.component_names,
        "measured_area_m2": float(fitted.grid.measured.any(axis=0).sum()) * fitted.grid.resolution_m**2,
        "noise_sd_ut": [float(sd) for sd in fitted.grid.noise_sd_uT],
        "error_correlation_m": fitted.grid.error_correlation_m,
        "error_structure": asdict(fitted.grid.error_structure),
        "surveys": {survey_id: asdict(report) for survey_id, report in fitted.consistency.items()},
        "disturbances": _disturbances(fitted, walks),
        "excluded_s": dict(excluded_s),
        "changes": changes,
        "hard_iron": fitted.hard_iron,
        "refinement": fitted.hyperparameters.get("refinement"),
        "out_of_date": [asdict(region) for region in fitted.out_of_date],
    }
    return json.dumps(quality, sort_keys=True, allow_nan=False).encode()
