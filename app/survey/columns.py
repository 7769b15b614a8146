"""The canonical columns of a survey, and the checks every table of samples has to pass.

`t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut` and optionally `qw,qx,qy,qz` (then b is in the body frame). A survey of |B| alone
may carry one column, `b_ut` or `bx_ut`, instead of three.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, TooLarge, UnreadableSurvey
from app.field.samples import SampleFrame, Samples
from app.geometry import Array, rotate_by_quaternion
from app.survey.units import field_faults

__all__ = [
    "MAX_FAULTS",
    "MAX_SAMPLES",
    "Columns",
    "check_sample_count",
    "columns_to_read",
    "numbers_of",
    "samples_from_columns",
]

MAX_SAMPLES = 2_000_000
"""Most samples in one survey: eleven columns of that many doubles are 176 MB."""
MAX_FAULTS = 20
"""Most faults listed for one file."""
MAX_HORIZONTAL_M = 10_000.0
MAX_VERTICAL_M = 1_000.0
LARGEST_VALUE = 1e100
JUMP_M, JUMP_M_PER_S = 20.0, 50.0
QUATERNION_NORM_TOLERANCE = 0.05

POSITION = ("x_m", "y_m", "z_m")
FIELD = ("bx_ut", "by_ut", "bz_ut")
QUATERNION = ("qw", "qx", "qy", "qz")

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Parsed columns of n numbers each, and where row i stands in the file ("line 7")."""

    values: Mapping[str, Array]
    location: Callable[[int], str]

    def __len__(self) -> int:
        return len(self.values["t_s"])

    def stack(self, names: Collection[str]) -> Array:
        """Some of the columns as (n, k)."""
        return np.stack([self.values[name] for name in names], axis=1)

    def faults(self, wrong: Mask, column: str | None, reason: Callable[[int], str]) -> list[Fault]:
        """A fault for each of the first rows that are wrong."""
        suffix = f", column {column}" if column else ""
        return [Fault(self.location(int(i)) + suffix, reason(int(i))) for i in np.flatnonzero(wrong)[:MAX_FAULTS]]


def check_sample_count(count: int) -> None:
    """Raise TooLarge for more samples than one survey may have, before memory is spent on them."""
    if count > MAX_SAMPLES:
        raise TooLarge(
            f"a survey may have {MAX_SAMPLES:,} samples, this one has {count:,}; thin it or split it into several walks"
        )


def columns_to_read(found: Collection[str], frame: SampleFrame) -> tuple[str, ...]:
    """Which columns of a file to read, given the names it has.

    Raises UnreadableSurvey that says which columns are missing and what was found instead.
    """
    field: tuple[str, ...] = FIELD
    if frame == "norm" and not set(FIELD) <= set(found):
        field = ("b_ut",) if "b_ut" in found else ("bx_ut",)
    quaternion = QUATERNION if set(QUATERNION) & set(found) else ()
    wanted = ("t_s", *POSITION, *field, *(quaternion if len(field) == 3 else ()))
    missing = [name for name in wanted if name not in found]
    if missing:
        names = ", ".join(str(name)[:40] for name in list(found)[:20]) or "none"
        raise UnreadableSurvey(
            f"the survey lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; found: {names}. "
            f"Name the columns t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut and optionally qw,qx,qy,qz",
            Fault("header", f"missing {', '.join(missing)}; found {names}"),
        )
    return wanted


def numbers_of(column: Any) -> Array:
    """An Arrow column of doubles; nulls become NaN. Arrow's own `to_numpy` would load pandas, where that is installed:
    a second that the first upload waits for."""
    whole = column if column.null_count == 0 else column.fill_null(np.nan)
    return np.array(np.from_dlpack(whole.combine_chunks()))


def samples_from_columns(
    columns: Columns, frame: SampleFrame, correct: Callable[[Array], Array] | None = None
) -> tuple[Samples, list[str]]:
    """Checked samples, and what was assumed to get them, as sentences. `correct` is a calibration of the sensor.

    Raises UnreadableSurvey with every kind of fault found, at most `MAX_FAULTS` in all.
    """
    if len(columns) < 2:
        raise UnreadableSurvey(
            "the survey holds no samples; the file ends after its header"
            if len(columns) == 0
            else "the survey holds a single sample; a walk needs two at least",
            Fault("file", f"{len(columns)} samples"),
        )
    _refuse(_not_finite(columns), "the survey holds values that are not finite numbers; remove those samples")
    _refuse(_not_in_order(columns), "time has to increase from each sample to the next; sort and deduplicate the rows")
    _refuse(_not_in_a_building(columns), "the survey leaves the building; give metres in the building frame")
    B_uT, q, assumptions = _field(columns, frame, correct)
    kept: SampleFrame = "building" if q is not None else frame
    return Samples(columns.values["t_s"], columns.stack(POSITION), B_uT, kept, q), assumptions


def _refuse(faults: list[Fault], message: str) -> None:
    if faults:
        raise UnreadableSurvey(f"{message} ({faults[0].location}: {faults[0].reason})", *faults[:MAX_FAULTS])


def _not_finite(columns: Columns) -> list[Fault]:
    def reason(x: float) -> str:
        return f"{x:g} is beyond any measurement" if np.isfinite(x) else f"{x} is not finite"

    faults: list[Fault] = []
    for name, column in columns.values.items():
        wrong = ~(np.abs(column) <= LARGEST_VALUE)
        faults += columns.faults(wrong, name, lambda i, column=column: reason(float(column[i])))  # type: ignore[misc]
    return faults


def _not_in_order(columns: Columns) -> list[Fault]:
    t_s = columns.values["t_s"]
    wrong = np.concatenate([[False], np.diff(t_s) <= 0])

    def reason(i: int) -> str:
        verb = "repeats" if t_s[i] == t_s[i - 1] else "goes back to"
        return f"time {verb} {t_s[i]:.9g} s after {t_s[i - 1]:.9g} s"

    return columns.faults(wrong, "t_s", reason)


def _not_in_a_building(columns: Columns) -> list[Fault]:
    faults: list[Fault] = []
    for name, limit_m in zip(POSITION, (MAX_HORIZONTAL_M, MAX_HORIZONTAL_M, MAX_VERTICAL_M), strict=True):
        x = columns.values[name]
        faults += columns.faults(
            np.abs(x) > limit_m,
            name,
            lambda i, x=x, limit_m=limit_m: (  # type: ignore[misc]
                f"{x[i]:,.9g} m is farther than {limit_m:,.0f} m from the building's origin; subtract the origin"
            ),
        )
    if faults:
        return faults
    step_m = np.linalg.norm(np.diff(columns.stack(POSITION), axis=0), axis=1)
    jump = np.concatenate([[False], (step_m > JUMP_M) & (step_m > JUMP_M_PER_S * np.diff(columns.values["t_s"]))])
    return columns.faults(jump, None, lambda i: f"a jump of {step_m[i - 1]:,.0f} m from the sample before")


def _field(
    columns: Columns, frame: SampleFrame, correct: Callable[[Array], Array] | None
) -> tuple[Array, Array | None, list[str]]:
    """The field in the frame of the samples, the attitude if the file knew it, and what was assumed."""
    names = tuple(name for name in columns.values if name.endswith("_ut"))
    b = columns.stack(names)
    if correct is not None:
        if "qw" not in columns.values:
            reason = "a calibration is of the sensor's own axes: give b in them, with qw,qx,qy,qz"
            raise UnreadableSurvey(f"the calibration cannot be applied: {reason}", Fault("calibration", reason))
        b = correct(b)
    norm_uT = np.linalg.norm(b, axis=1)
    message, faults = field_faults(norm_uT, columns.location)
    if message:
        raise UnreadableSurvey(message, *faults[:MAX_FAULTS])
    if "qw" in columns.values:
        q, renormalised = _unit_quaternions(columns)
        assumed = ["b is in the body frame and was rotated to the building frame by qw,qx,qy,qz"]
        if correct is not None:
            assumed.append("b was corrected by the device's calibration first")
        if frame != "building":
            assumed.append(f"frame={frame} was ignored, because the file has quaternions")
        if renormalised:
            assumed.append(f"{renormalised} quaternions were normalised to length 1")
        return rotate_by_quaternion(q, b), q, assumed
    if frame != "norm":
        return b, None, [f"b is in the {frame} frame"]
    source = "the length of (bx_ut, by_ut, bz_ut)" if len(names) == 3 else names[0]
    return norm_uT[:, None], None, [f"the field's norm is {source}"]


def _unit_quaternions(columns: Columns) -> tuple[Array, int]:
    q = columns.stack(QUATERNION)
    length = np.linalg.norm(q, axis=1)
    _refuse(
        columns.faults(
            np.abs(length - 1.0) > QUATERNION_NORM_TOLERANCE,
            "qw,qx,qy,qz",
            lambda i: (
                "a zero quaternion is no rotation"
                if length[i] < 1e-6
                else f"a quaternion of length {length[i]:.3g}, not 1"
            ),
        ),
        "quaternions have to be unit rotations [w, x, y, z] from body to building",
    )
    return q / length[:, None], int(np.sum(np.abs(length - 1.0) > 1e-4))
