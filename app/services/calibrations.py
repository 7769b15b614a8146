"""A device's calibrations as they are kept: made once, never changed, applied by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.calibration.coverage import OrientationCoverage
from app.calibration.drift import Drift, fit_drift
from app.calibration.equivalence import EquivalentCalibrations, compare_calibrations
from app.calibration.fit import CalibrationFit
from app.calibration.sensor_model import SensorModel
from app.db.tables import Calibration, Organisation
from app.errors import Fault, InvalidInput, NotFound
from app.geometry import Array
from app.services.artefacts import pack

__all__ = [
    "AppliedCalibration",
    "applied",
    "compare_devices",
    "device_drift",
    "find_calibration",
    "keep_readings",
    "model_as_json",
    "record_calibration",
    "stored_model",
]


@dataclass(frozen=True, slots=True)
class AppliedCalibration:
    """A calibration as it is applied to readings, and what is said of it wherever it was."""

    id: str
    device: str
    version: int
    model: SensorModel

    @property
    def label(self) -> str:
        """Of what surveys of one calibration share."""
        return f"{self.device} v{self.version}"

    @property
    def told(self) -> dict[str, Any]:
        return {"id": self.id, "device": self.device, "version": self.version}


def applied(row: Calibration) -> AppliedCalibration:
    return AppliedCalibration(row.id, row.device, row.version, stored_model(row.model))


def stored_model(model: Mapping[str, Any]) -> SensorModel:
    """The model in a row's JSON."""
    return SensorModel(
        np.asarray(model["hard_iron_ut"], dtype=np.float64), np.asarray(model["correction"], dtype=np.float64)
    )


def model_as_json(model: SensorModel) -> dict[str, Any]:
    return {"hard_iron_ut": model.hard_iron_uT.tolist(), "correction": model.correction.tolist()}


def find_calibration(
    session: Session, organisation_id: str, calibration_id: str | None, device: str | None
) -> AppliedCalibration | None:
    """The calibration of this id, or the device's newest; None when neither is told.

    Raises NotFound, and InvalidInput when an id is of another device.
    """
    if calibration_id is None and device is None:
        return None
    own = select(Calibration).where(Calibration.organisation_id == organisation_id)
    if calibration_id is None:
        of_device = own.where(Calibration.device == device).order_by(Calibration.version.desc()).limit(1)
        row = session.scalars(of_device).first()
        if row is None:
            raise NotFound(f"device {device} has no calibration yet; make one by POST /v1/calibrations")
        return applied(row)
    row = session.scalars(own.where(Calibration.id == calibration_id)).first()
    if row is None:
        raise NotFound(f"no calibration {calibration_id}")
    if device not in (None, row.device):
        reason = f"calibration {calibration_id} is of device {row.device}"
        raise InvalidInput(reason, Fault("device", reason))
    return applied(row)


def keep_readings(blobs: BlobStore, readings: Mapping[str, Array]) -> str:
    """Keep a calibration's readings, before the transaction that names them: a slow store must hold up nobody else."""
    return blobs.put(pack({"kind": "calibration"}, dict(readings)))


def record_calibration(
    session: Session, organisation_id: str, *,
    device: str, fit: CalibrationFit, reference: Mapping[str, Any], samples_sha256: str, measured_at: datetime,
) -> Calibration:  # fmt: skip
    """Keep a calibration as the device's next version; those of one organisation one after the other."""
    session.execute(
        update(Organisation)
        .where(Organisation.id == organisation_id)
        .values(created_at=Organisation.created_at)
        .execution_options(synchronize_session=False)
    )  # locks the row, so that the newest stays the newest
    newest = session.scalar(
        select(func.max(Calibration.version)).where(
            Calibration.organisation_id == organisation_id, Calibration.device == device
        )
    )
    row = Calibration(
        organisation_id=organisation_id,
        device=device,
        version=(newest or 0) + 1,
        method=fit.method,
        model=model_as_json(fit.model),
        fit=_fit_as_json(fit),
        reference=dict(reference),
        samples_sha256=samples_sha256,
        measured_at=measured_at,
    )
    session.add(row)
    session.flush()
    return row


def device_drift(session: Session, organisation_id: str, device: str, method: str | None) -> tuple[Drift, list[str]]:
    """How a device's calibrations by one method (default: its newest's) change over time, and their ids.

    Raises NotFound for a device without any, InvalidInput for a single one.
    """
    of_device = select(Calibration).where(Calibration.organisation_id == organisation_id, Calibration.device == device)
    rows = session.scalars(of_device.order_by(Calibration.version)).all()
    if not rows:
        raise NotFound(f"device {device} has no calibration yet; make one by POST /v1/calibrations")
    method = method or rows[-1].method
    rows = [row for row in rows if row.method == method]
    if len(rows) < 2:
        reason = f"device {device} has {len(rows)} calibration by {method}; a drift takes two: calibrate it again"
        raise InvalidInput(reason, Fault("/query/device", reason))
    days = [row.measured_at.timestamp() / 86_400.0 for row in rows]
    return fit_drift(days, [_stored_fit(row) for row in rows]), [row.id for row in rows]


def compare_devices(
    session: Session, organisation_id: str, ids: tuple[str, str], magnitude_uT: float, tolerance_uT: float
) -> EquivalentCalibrations:
    """Whether two calibrations, of two devices or of one, come to the same. Raises NotFound, InvalidInput."""
    rows = [session.get(Calibration, each) for each in ids]
    for calibration_id, row in zip(ids, rows, strict=True):
        if row is None or row.organisation_id != organisation_id:
            raise NotFound(f"no calibration {calibration_id}")
    first, second = (_stored_fit(row) for row in rows if row is not None)
    return compare_calibrations(first, second, magnitude_uT, tolerance_uT, np.random.default_rng(0))


def _stored_fit(row: Calibration) -> CalibrationFit:
    told = row.fit
    coverage = told["coverage"]
    return CalibrationFit(
        method=row.method,
        model=stored_model(row.model),
        parameters=told["parameters"],
        parameter_sd=told["parameter_sd"],
        covariance=np.asarray(told["covariance"], dtype=np.float64),
        residual_rms_uT=told["residual_rms_ut"],
        residual_max_uT=told["residual_max_ut"],
        samples=told["samples"],
        outliers=told["outliers"],
        coverage=OrientationCoverage(**{**coverage, "unseen_axes": tuple(coverage["unseen_axes"])}),
        determined=tuple(told["determined"]),
        undetermined=tuple(told["undetermined"]),
        advice=tuple(told["advice"]),
    )


def _fit_as_json(fit: CalibrationFit) -> dict[str, Any]:
    coverage = fit.coverage
    return {
        "parameters": dict(fit.parameters),
        "parameter_sd": dict(fit.parameter_sd),
        "covariance": fit.covariance.tolist(),
        "residual_rms_ut": fit.residual_rms_uT,
        "residual_max_ut": fit.residual_max_uT,
        "samples": fit.samples,
        "outliers": fit.outliers,
        "coverage": {
            "kind": coverage.kind,
            "cells_seen": coverage.cells_seen,
            "cells": coverage.cells,
            "unseen_axes": list(coverage.unseen_axes),
            "condition": coverage.condition,
        },
        "determined": list(fit.determined),
        "undetermined": list(fit.undetermined),
        "advice": list(fit.advice),
    }
