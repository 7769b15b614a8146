"""A synthetic building to demonstrate with: steel on several floors, surveys in lanes, and walks nobody has seen."""

import numpy as np

from app.cli.demo.world import DemoFloor, Question, SurveyFile, Told, World, body_of
from app.synthetic import (
    Magnetometer,
    SyntheticBuilding,
    lawn_mower,
    make_building,
    random_waypoints,
    survey,
    survey_csv,
    window,
)

__all__ = ["synthetic_world"]

WINDOW_LENGTHS_M = (2.0, 5.0, 10.0, 20.0)
SAMPLE_EVERY_M = 0.5
_LANES = (("x", 0.0), ("x", 1.0), ("y", 0.0), ("y", 1.0))  # four walks per floor: lanes 2 m apart, interleaved


def synthetic_world(
    rng: np.random.Generator, *, width_m: float, depth_m: float, floors: int, windows: int, told: Told
) -> World:
    """Draw a building, walk its surveys and `windows` windows of unseen walks, spread over floors and lengths."""
    building = make_building(rng, width_m=width_m, depth_m=depth_m, floors=floors)
    total = floors * len(_LANES) + windows
    demo_floors = []
    for floor in range(floors):
        surveys = []
        for k, (along, offset_m) in enumerate(_LANES):
            walk = lawn_mower(building, floor, rng, along=along, lane_m=2.0, offset_m=offset_m)  # type: ignore[arg-type]
            data = survey_csv(survey(building, walk, _surveyor(rng), rng))
            surveys.append(SurveyFile.of(f"lanes along {along}, {'even' if offset_m == 0 else 'odd'}", "csv", data))
            told(floor * len(_LANES) + k + 1, total)
        demo_floors.append(DemoFloor(f"Floor {floor}", _floor_body(building, floor), surveys))
    questions = []
    for k in range(windows):
        questions.append(_question(building, rng, k, floors))
        told(floors * len(_LANES) + k + 1, total)
    return World(
        building="Synthetic building",
        floors=demo_floors,
        questions=questions,
        notes=[
            f"{width_m:g} x {depth_m:g} m, {floors} floors; surveys in lanes 1 m apart both ways: sensor noise 0.4 uT, "
            "leftover bias 0.3 uT, labels 0.1 m; windows level, heading unknown, step scale 2 %"
        ],
        field_uT=building.field_uT,
        probes_m=[building.device_grid_m(floor).reshape(-1, 3) for floor in range(floors)],
    )


def _surveyor(rng: np.random.Generator) -> Magnetometer:
    """A calibrated sensor on somebody who knows where they are to a decimetre."""
    return Magnetometer(
        noise_uT=0.4,
        hard_iron_uT=tuple(rng.normal(0.0, 0.3, 3)),
        tilt_sd_rad=0.005,
        yaw_sd_rad=0.01,
        position_sd_m=0.1,
    )


def _walker(rng: np.random.Generator) -> Magnetometer:
    """A phone in the hand of somebody who does not know where they are."""
    return Magnetometer(
        noise_uT=0.5,
        hard_iron_uT=tuple(rng.normal(0.0, 0.3, 3)),
        tilt_sd_rad=0.005,
        yaw_sd_rad=0.01,
        step_scale_sd=0.02,
        step_noise_m=0.02,
    )


def _question(building: SyntheticBuilding, rng: np.random.Generator, k: int, floors: int) -> Question:
    floor, length_m = k % floors, WINDOW_LENGTHS_M[(k // floors) % len(WINDOW_LENGTHS_M)]
    walk = random_waypoints(building, floor, rng, length_m=length_m + 10.0)
    samples = round(length_m / SAMPLE_EVERY_M) + 1
    seen, pose = window(building, walk, _walker(rng), rng, length_m=length_m, samples=samples)
    s = walk.path_length_m()
    end = int(np.argmin(np.linalg.norm(walk.p_building_m - pose.position_m, axis=1)))
    start = int(np.searchsorted(s, s[end] - length_m))
    return Question(
        walk=f"walk {k}",
        length_m=length_m,
        body={"window": body_of(seen)},
        floor=floor,
        truth_m=pose.position_m,
        path_m=walk.p_building_m[start : end + 1, :2],
    )


def _floor_body(building: SyntheticBuilding, floor: int) -> dict[str, object]:
    w, d = building.width_m, building.depth_m
    ring = [[0.0, 0.0], [w, 0.0], [w, d], [0.0, d], [0.0, 0.0]]
    return {
        "name": f"Floor {floor}",
        "ordinal": floor,
        "elevation_m": building.elevations_m[floor],
        "height_m": building.storey_m,
        "outline": {"type": "Polygon", "coordinates": [ring]},
    }
