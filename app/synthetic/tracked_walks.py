"""Walks through the analytic building to be followed: maps of its surveys, a phone that drifts, some stairs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.services.evaluate_tracks import TrackEvaluation, TrackPlan, follow_all
from app.services.fold_maps import fit_floors, places_m
from app.services.followed_walks import Start, WalkToFollow, covered
from app.services.held_out_walks import Told
from app.synthetic.building import SyntheticBuilding, make_building
from app.synthetic.sensors import Magnetometer, survey
from app.synthetic.steps import Carried, DeadReckoned, carry
from app.synthetic.storeys import Way, carry_between_storeys, walk_between_storeys
from app.synthetic.walks import lawn_mower, random_waypoints

__all__ = ["SyntheticPlan", "evaluate_synthetic_tracks", "walks_to_follow"]

SURVEYOR = Magnetometer(noise_uT=0.4, tilt_sd_rad=np.deg2rad(0.5), yaw_sd_rad=np.deg2rad(1.0), position_sd_m=0.05)
PHONE = Magnetometer(noise_uT=0.4, tilt_sd_rad=np.deg2rad(0.5), yaw_sd_rad=np.deg2rad(1.0))
HARD_IRON_UT = 0.3  # sd per axis of what calibration left, new for every survey and walk
WAYS: tuple[Way, ...] = ("stairs", "lift")


@dataclass(frozen=True, slots=True)
class SyntheticPlan:
    """A building, how many walks, and how long they are; every second one changes floors where there are several."""

    walks: int
    length_m: float = 60.0
    floors: int = 4
    width_m: float = 40.0
    depth_m: float = 30.0
    seed: int = 0


def evaluate_synthetic_tracks(synthetic: SyntheticPlan, plan: TrackPlan, told: Told) -> TrackEvaluation:
    """Map the building floor by floor, and let each filter follow the walks on all floors."""
    rng = np.random.default_rng(synthetic.seed)
    size = {"width_m": synthetic.width_m, "depth_m": synthetic.depth_m}
    building = make_building(rng, floors=synthetic.floors, **size)
    surveys = {str(k): _surveys(building, k, rng) for k in range(synthetic.floors)}
    fitted = fit_floors({k: (walks, plan.spec) for k, walks in surveys.items()}, plan.processes, told)
    grids: dict[str, FieldGrid] = {k: fitted[k].grid for k in surveys}
    walks = walks_to_follow(building, synthetic, [places_m(each) for each in surveys.values()], rng)
    return TrackEvaluation(tuple(follow_all(dict.fromkeys(grids, grids), walks, plan, told)), {})


def _surveys(building: SyntheticBuilding, floor: int, rng: np.random.Generator) -> dict[str, Samples]:
    """Four surveys in lanes of 2 m, together one metre apart both ways, each with its own hard iron."""
    lanes = [
        lawn_mower(building, floor, rng, along=along, lane_m=2.0, offset_m=offset_m)
        for along in ("x", "y")
        for offset_m in (0.0, 1.0)
    ]
    return {f"s{k}": survey(building, walk, _with_hard_iron(SURVEYOR, rng), rng) for k, walk in enumerate(lanes)}


def walks_to_follow(
    building: SyntheticBuilding, synthetic: SyntheticPlan, mapped_m: Sequence[np.ndarray], rng: np.random.Generator
) -> list[WalkToFollow]:
    """Walks from the floors in turn; the odd ones go to another floor, by stairs and by lift in turn."""
    out = []
    for k in range(synthetic.walks):
        floor, sensor = k % synthetic.floors, _with_hard_iron(PHONE, rng)
        if k % 2 and synthetic.floors > 1:
            to = floor + 1 if floor == 0 or (floor < synthetic.floors - 1 and rng.uniform() < 0.5) else floor - 1
            way = WAYS[(k // 2) % 2]
            walk = walk_between_storeys(building, floor, to, way, rng, length_m=synthetic.length_m)
            carried, name = carry_between_storeys(building, walk, sensor, DeadReckoned(), rng), f"{k:03d}-{way}"
            heading_rad = float(walk.walk.heading_rad[0])
        else:
            plain = random_waypoints(building, floor, rng, length_m=synthetic.length_m)
            carried, name = carry(building, plain, sensor, DeadReckoned(), rng), f"{k:03d}"
            heading_rad = float(plain.heading_rad[0])
        out.append(_to_follow(carried, floor, name, heading_rad, synthetic.length_m, mapped_m[floor]))
    return out


def _to_follow(
    carried: Carried, floor: int, name: str, heading_rad: float, length_m: float, mapped_m: np.ndarray
) -> WalkToFollow:
    """The first `length_m` of what a device sends; its frame is level, turned as the device is at the first step."""
    way_m = np.linalg.norm(np.diff(carried.truth_m[:, :2], axis=0), axis=1)
    walked_m = np.concatenate([[0.0], np.cumsum(way_m)])
    n = int(np.searchsorted(walked_m, length_m, side="right"))
    p_m = carried.truth_m[:n, :2]
    return WalkToFollow(
        floor_id=str(floor),
        name=name,
        covered=covered(p_m, mapped_m),
        steps=carried.steps[:n],
        truth_m=p_m,
        truth_floor=carried.floor[:n].astype(np.int64),
        walked_m=walked_m[:n],
        start=Start(floor, (float(p_m[0, 0]), float(p_m[0, 1])), heading_rad),
    )


def _with_hard_iron(sensor: Magnetometer, rng: np.random.Generator) -> Magnetometer:
    x, y, z = rng.normal(0.0, HARD_IRON_UT, 3)
    return replace(sensor, hard_iron_uT=(float(x), float(y), float(z)))
