"""Real walks to demonstrate with: a folder of Android traces per floor, one walk in five held out by file name."""

import gzip
import json
import re
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from app.cli.demo.world import DemoFloor, Question, SurveyFile, Told, World, body_of
from app.errors import InvalidInput, UnreadableSurvey
from app.geometry import Array
from app.positioning.window import Window
from app.services.held_out_walks import hold_out
from app.services.judge_windows import COVERED_SHARE, COVERED_WITHIN_M, cut_windows
from app.survey.read import read_survey
from app.survey.walk import Walk

__all__ = ["traces_world"]

FORMAT = "indoor-location-2020"
WINDOW_LENGTHS_M = (10.0, 20.0, 40.0)
_MOST_SAMPLES = 400
_STOREY_M = 5.0  # taken, not known: traces have no elevations
_FEWEST_WALKS = 5


def traces_world(folder: Path, *, windows: int, told: Told) -> World:
    """Read a folder of floors. Windows are cut from the held-out walks, at most `windows` of each length.

    Raises InvalidInput when there is no floor with enough walks.
    """
    files = {each.name: _walk_files(each) for each in sorted(folder.iterdir()) if each.is_dir()}
    files = {name: walks for name, walks in files.items() if len(walks) >= _FEWEST_WALKS}
    if not files:
        raise InvalidInput(
            f"{folder} holds no floor: give a folder with one folder per floor, each with at least {_FEWEST_WALKS} "
            "walks (*.txt or *.txt.gz) in the format of the Indoor Location Competition 2.0"
        )
    total, done = sum(map(len, files.values())), 0
    floors, questions, notes = [], [], []
    for index, name in enumerate(files):
        surveys, walks = [], {}
        for walk_name, path in files[name].items():
            gzipped = path.read_bytes() if path.suffix == ".gz" else gzip.compress(path.read_bytes())
            surveys.append(SurveyFile(walk_name, FORMAT, gzipped))
            try:
                walks[walk_name] = read_survey(gzip.decompress(gzipped), format=FORMAT)
            except UnreadableSurvey as error:
                notes.append(f"{name}/{path.name} is left out: {error}")
            done += 1
            told(done, total)
        mapped, held_out = hold_out(walks)
        floors.append(DemoFloor(name, _floor_body(folder / name, index), [s for s in surveys if s.name in set(mapped)]))
        questions += _questions(walks, mapped, held_out, index)
    return World(
        building=folder.name,
        floors=floors,
        questions=_evenly(questions, windows),
        notes=[
            "real walks: labels are good to about a metre, so errors below that mean nothing",
            f"storeys are taken to be {_STOREY_M:g} m high: the traces do not say",
            *notes,
        ],
    )


def _walk_files(folder: Path) -> dict[str, Path]:
    names = (path for path in sorted(folder.iterdir()) if path.name.endswith((".txt", ".txt.gz")))
    return {path.name.split(".")[0]: path for path in names}


def _floor_body(folder: Path, index: int) -> dict[str, object]:
    number = re.search(r"-?\d+", folder.name)
    ordinal = int(number[0]) if number else index
    ordinal = -abs(ordinal) if folder.name.upper().startswith("B") else ordinal
    body: dict[str, object] = {"name": folder.name, "ordinal": ordinal, "elevation_m": _STOREY_M * ordinal}
    information = folder / "floor_info.json"
    if information.exists():
        plan = json.loads(information.read_text())["map_info"]
        w, d = float(plan["width"]), float(plan["height"])
        ring = [[0.0, 0.0], [w, 0.0], [w, d], [0.0, d], [0.0, 0.0]]
        body["outline"] = {"type": "Polygon", "coordinates": [ring]}
    return body


def _questions(walks: dict[str, Walk], mapped: list[str], held_out: list[str], floor: int) -> list[Question]:
    """Every window of every length of the held-out walks of one floor."""
    tree = cKDTree(np.concatenate([walks[name].samples.p_building_m[:, :2] for name in mapped]))
    questions = []
    for name in held_out:
        samples, reckoned = walks[name].samples, walks[name].dead_reckoning
        assert reckoned is not None
        near = np.asarray(tree.query(samples.p_building_m[:, :2])[0] <= COVERED_WITHIN_M)
        for length_m in WINDOW_LENGTHS_M:
            for part, seen in cut_windows(reckoned, length_m):
                covered = float(near[part].mean()) >= COVERED_SHARE
                path_m = samples.p_building_m[part]
                questions.append(_question(name, length_m, seen, floor, path_m, covered))
    return questions


def _question(walk: str, length_m: float, seen: Window, floor: int, path_m: Array, covered: bool) -> Question:
    kept = np.unique(np.linspace(0, len(seen.B_uT) - 1, min(len(seen.B_uT), _MOST_SAMPLES)).round().astype(int))
    thinned = Window(
        frame=seen.frame,
        B_uT=seen.B_uT[kept],
        displacement_m=seen.displacement_m[kept],
        noise_uT=seen.noise_uT,
        heading_rad=seen.heading_rad,
        heading_sd_rad=seen.heading_sd_rad,
        yaw_rad=None if seen.yaw_rad is None else seen.yaw_rad[kept],
    )
    return Question(walk, length_m, {"window": body_of(thinned)}, floor, path_m[-1], path_m[:, :2], covered)


def _evenly(questions: list[Question], most: int) -> list[Question]:
    """At most `most` of each length, evenly spread over floors and walks."""
    chosen = []
    for length_m in WINDOW_LENGTHS_M:
        of_length = [each for each in questions if each.length_m == length_m]
        picks = np.unique(np.linspace(0, len(of_length) - 1, min(most, len(of_length))).round().astype(int))
        chosen += [of_length[k] for k in picks]
    return chosen
