"""One-shot positioning: a window against the maps of the candidate floors, to a fix with its uncertainty.

`prepare_floors` once per set of maps (cache the floors behind the maps' content hashes and noise), then `locate` per
window. Pure and deterministic: no clock, no randomness, nothing kept.
"""

from collections.abc import Sequence

import numpy as np

from app.errors import Fault, InvalidInput, InvalidWindow
from app.field.grid import FieldGrid
from app.positioning.belief import believe
from app.positioning.explanation import Explanation, explain
from app.positioning.features import common_components
from app.positioning.fix import AblEstimate, ContourEstimate, Fix, LocateOptions, MadEstimate, MlrEstimate, Prior
from app.positioning.floors import SearchableFloor, prepare_floor, prepare_floors, reduce_floor, shared_noise_sd_uT
from app.positioning.matching import match
from app.positioning.verdict import conclude
from app.positioning.window import Composition, Window

__all__ = [
    "SearchableFloor",
    "locate",
    "locate_and_explain",
    "prepare_floor",
    "prepare_floors",
    "shared_noise_sd_uT",
    "warm_up",
]

TECHNIQUES = ("ml", "mlr", "abl")


def locate(
    window: Window,
    floors: Sequence[SearchableFloor],
    *,
    composition: Composition = "raw",
    techniques: Sequence[str] = TECHNIQUES,
    prior: Prior | None = None,
    options: LocateOptions | None = None,
) -> Fix:
    """Where the device is at the window's last sample, in the building frame, and how sure that is.

    Maximum likelihood always answers; MLR and ABL only where they may (Shockley 8.1-8.3), and say why not. `prior` is a
    Gaussian on the position of the last sample, in all three axes. An estimate not in `techniques` is unavailable.
    Several floors of the same components are compared under one noise (`shared_noise_sd_uT`); `prepare_floors` has them
    so at once, otherwise they are prepared again here.
    Raises InvalidWindow, IncompatibleFrames (a map cannot answer this frame), InvalidInput (prior or options).
    """
    return locate_and_explain(
        window, floors, composition=composition, techniques=techniques, prior=prior, options=options, explained=False
    )[0]


def locate_and_explain(
    window: Window,
    floors: Sequence[SearchableFloor],
    *,
    composition: Composition = "raw",
    techniques: Sequence[str] = TECHNIQUES,
    prior: Prior | None = None,
    options: LocateOptions | None = None,
    explained: bool = True,
) -> tuple[Fix, Explanation | None]:
    """`locate`, and why: None where it is not to be explained, or no floor had a map to search."""
    options = options or LocateOptions()
    _check_window(window, composition)
    _check_options(prior, options)
    if not floors:
        nothing = "none of the floors asked for has a map to search; upload surveys and build one"
        return Fix(
            "unmapped", nothing, None, MlrEstimate(False, None, reason=nothing), AblEstimate(False, reason=nothing),
            MadEstimate(False, reason=nothing), ContourEstimate(False, reason=nothing), None,
        ), None  # fmt: skip
    shared = common_components(window.frame, {floor.floor_id: floor.components for floor in floors})
    noise_sd_uT = shared_noise_sd_uT([floor.grid for floor in floors])
    ready = [reduce_floor(floor, shared, noise_sd_uT) for floor in floors]
    matched = match(window, ready, shared, composition, prior, options)
    belief = believe(matched)
    return conclude(matched, belief, techniques, options), explain(matched, belief) if explained else None


def warm_up() -> None:
    """Compile the search kernels (or load them from numba's cache) before the first query has to wait for it."""
    cells = np.zeros((1, 20, 20, 3), dtype=np.float32)
    grid = FieldGrid(
        "vector", (0.0, 0.0), 0.5, np.zeros(1), cells, cells + 1, np.zeros((*cells.shape, 2), np.float32),
        np.ones(cells.shape[:3], dtype=bool), np.zeros(3), np.ones(3), np.ones(3),
    )  # fmt: skip
    floor = prepare_floor("warm-up", grid)
    step = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    window = Window("level", np.ones((2, 3)), step, 1.0, heading_rad=0.0, heading_sd_rad=0.1)
    locate(window, [floor])
    locate(window, [floor], composition="demeaned")


def _check_window(window: Window, composition: Composition) -> None:
    B, displacement = np.asarray(window.B_uT), np.asarray(window.displacement_m)
    n = len(B)
    faults = []
    if n == 0 or B.ndim != 2 or B.shape[1] != (1 if window.frame == "norm" else 3):
        faults.append(
            Fault("/window/b_ut", f"needs at least one sample of {1 if window.frame == 'norm' else 3} numbers")
        )
    elif not np.all(np.isfinite(B)):
        faults.append(Fault(f"/window/b_ut/{np.flatnonzero(~np.isfinite(B).all(axis=1))[0]}", "is not a finite number"))
    if displacement.shape != (n, 3):
        faults.append(
            Fault("/window/displacement_m", f"needs {n} rows of three, one per sample; has {displacement.shape}")
        )
    elif not np.all(np.isfinite(displacement)):
        faults.append(Fault("/window/displacement_m", "holds a number that is not finite"))
    if not (np.isfinite(window.noise_uT) and window.noise_uT >= 0.0):
        faults.append(Fault("/window/noise_ut", "must be a finite number of microtesla, not negative"))
    if window.heading_rad is not None and not np.isfinite(window.heading_rad):
        faults.append(Fault("/window/heading_rad", "must be finite, or null when it is unknown"))
    if window.heading_sd_rad is not None and not window.heading_sd_rad >= 0.0:
        faults.append(Fault("/window/heading_sd_rad", "must not be negative"))
    if window.yaw_rad is not None and (np.shape(window.yaw_rad) != (n,) or not np.all(np.isfinite(window.yaw_rad))):
        faults.append(Fault("/window/yaw_rad", f"needs {n} finite numbers, one per sample"))
    if composition in ("demeaned", "differenced") and n == 1:
        faults.append(Fault("/composition", "one sample without its mean tells nothing; send more samples or use raw"))
    if composition not in ("raw", "demeaned", "differenced", "feature"):
        faults.append(Fault("/composition", f"{composition} is not offered; use raw, demeaned, differenced or feature"))
    if faults:
        raise InvalidWindow(f"the window cannot be matched: {faults[0].location} {faults[0].reason}", *faults)


def _check_options(prior: Prior | None, options: LocateOptions) -> None:
    faults = []
    if prior is not None and not (
        np.all(np.isfinite(prior.position_m)) and np.isfinite(prior.sd_m) and prior.sd_m > 0.0
    ):
        faults.append(Fault("/prior", "needs a finite position and a positive sd_m"))
    positive = {
        "mlr_ratio": options.mlr_ratio,
        "mlr_min_distance_m": options.mlr_min_distance_m,
        "abl_bin_m": options.abl_bin_m,
    }
    known = {
        "bias_sd_ut": options.bias_sd_uT,
        "step_scale_sd": options.step_scale_sd,
        "heading_drift_sd_rad_per_m": options.heading_drift_sd_rad_per_m,
    }
    faults += [
        Fault(f"/options/{name}", "must be a finite number, not negative")
        for name, value in known.items()
        if not 0.0 <= value < np.inf
    ]
    faults += [
        Fault(f"/options/{name}", "must be positive") for name, value in positive.items() if not 0.0 < value < np.inf
    ]
    if not 0.0 <= options.abl_min_probability <= 1.0:
        faults.append(Fault("/options/abl_min_probability", "must lie between 0 and 1"))
    if not 0.0 < options.gate_probability < 1.0:
        faults.append(Fault("/options/gate_probability", "must lie between 0 and 1"))
    if faults:
        raise InvalidInput(f"the question cannot be answered: {faults[0].location} {faults[0].reason}", *faults)
