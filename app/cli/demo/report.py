"""The demonstration's result in figures: tables for a person, report.json for scripts, and whether it makes sense."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from scipy.stats import binom

from app.cli.demo.journey import Answer, MappedFloor
from app.cli.demo.world import World
from app.geometry import Array

__all__ = ["TECHNIQUES", "Judged", "absurdities", "judge", "map_table", "position_tables", "report", "status_line"]

TECHNIQUES = ("ml", "mlr", "abl", "posterior")
_NAMES = {"ml": "ML", "mlr": "MLR", "abl": "ABL", "posterior": "posterior"}
_STATED = 0.95  # what a stated radius holds, of a world whose truth is known
_CHANCE = 1e-4  # fewer held than an honest server would have this rarely are absurd


@dataclass(frozen=True, slots=True)
class Judged:
    """One technique's answer to one question; `error_m` is horizontal, inf on the wrong floor, None unanswered."""

    technique: str
    answer: Answer
    error_m: float | None
    right_floor: bool
    radius_95_m: float


def judge(answers: list[Answer], floor_ids: list[str]) -> list[Judged]:
    """Every technique's answer to every question against the truth."""
    return [_judged(each, technique, floor_ids) for each in answers for technique in TECHNIQUES]


def _judged(answer: Answer, technique: str, floor_ids: list[str]) -> Judged:
    posterior = answer.fix["posterior"]
    estimate = posterior if technique == "posterior" else answer.fix["estimates"][technique]
    radius = posterior["radius_95_m"] if posterior else np.nan
    if estimate is None or estimate["position_m"] is None or not estimate.get("available", True):
        return Judged(technique, answer, None, False, radius)
    right_floor = estimate["floor_id"] == floor_ids[answer.question.floor]
    error_m = float(np.linalg.norm(np.array(estimate["position_m"][:2]) - answer.question.truth_m[:2]))
    return Judged(technique, answer, error_m if right_floor else np.inf, right_floor, radius)


def map_table(floors: list[MappedFloor]) -> Table:
    """Every floor's map: how well it predicts the walk left out, the true field, and which walks fit the others."""
    components = " ".join(floors[0].quality["components"])
    table = _table(
        "Maps",
        f"{components}; each survey is predicted from all the others; fit: consistent with them",
        ["floor", "walks", "mapped\nm²", "RMSE\nµT", "within 2\nsd, %", "fit the\nothers", "true RMSE\nµT"],
    )
    for floor in floors:
        score, verdicts = floor.map["score"], _verdicts(floor)
        table.add_row(
            floor.name,
            str(len(floor.map["survey_ids"])),
            f"{floor.quality['measured_area_m2']:,.0f}",
            _numbers(score["rmse_ut"], ".2f") if score else "-",
            _numbers([100 * x for x in score["coverage_2sigma"]], ".0f") if score else "-",
            f"{verdicts['consistent']} of {verdicts['consistent'] + verdicts['inconsistent']}",
            "unknown" if floor.error_uT is None else _numbers(_rms(floor.error_uT).tolist(), ".2f"),
        )
    return table


def position_tables(judged: list[Judged]) -> list[Table]:
    """All windows; and, where some went off the map, those that stayed on it."""
    on_the_map = [each for each in judged if each.answer.question.covered]
    tables = [_position_table("Positions of windows from unseen walks: any floor, no prior", judged)]
    if 0 < len(on_the_map) < len(judged):
        title = "Only windows of which at least 80 % has another walk within 1.5 m"
        tables.append(_position_table(title, on_the_map))
    return tables


def _position_table(title: str, judged: list[Judged]) -> Table:
    """True error against stated 95 % radius, per window length and technique."""
    table = _table(
        title,
        "errors: horizontal, infinite on a wrong floor; stated: median radius; held: error within it",
        ["technique", "window\nm", "asked", "answered\n%", "right\nfloor %", "error m\nmedian", "error m\n95 %",
         "stated m\n95 %", "held\n%"],
    )  # fmt: skip
    for length_m in sorted({each.answer.question.length_m for each in judged}):
        for technique in TECHNIQUES:
            mine = [e for e in judged if e.technique == technique and e.answer.question.length_m == length_m]
            row = summary(mine)
            table.add_row(
                _NAMES[technique], f"{length_m:g}", str(row["asked"]), _percent(row["answered"]),
                _percent(row["right_floor"]), _metres(row["error_50_m"]), _metres(row["error_95_m"]),
                _metres(row["radius_95_m"]), _percent(row["held"]), end_section=technique == TECHNIQUES[-1],
            )  # fmt: skip
    return table


def _table(title: str, caption: str, columns: list[str]) -> Table:
    table = Table(title=title, caption=caption, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(name, justify="right" if k else "left", no_wrap=True)
    return table


def summary(judged: list[Judged]) -> dict[str, Any]:
    """Figures of one technique: shares of those asked (`answered`) and of those answered (the others)."""
    answered = [each for each in judged if each.error_m is not None]
    errors = np.array([each.error_m for each in answered], dtype=np.float64)
    radii = np.array([each.radius_95_m for each in answered])
    nothing = len(answered) == 0
    return {
        "asked": len(judged),
        "answered": len(answered) / len(judged) if judged else None,
        "right_floor": None if nothing else float(np.mean([each.right_floor for each in answered])),
        "error_50_m": None if nothing else _quantile(errors, 0.50),
        "error_95_m": None if nothing else _quantile(errors, 0.95),
        "radius_95_m": None if nothing else float(np.median(radii)),
        "held": None if nothing else float(np.mean(errors <= radii)),
    }


def status_line(answers: list[Answer], judged: list[Judged]) -> str:
    """What the server itself thought of the windows, how often its radius then held, and how long it took."""
    told = []
    for status in ("fix", "ambiguous", "inconsistent", "unmapped"):
        mine = [e for e in judged if e.technique == "posterior" and e.answer.fix["status"] == status]
        told.append(
            f"{len(mine)} {status}" + (f" ({_percent(np.mean([_held(e) for e in mine]))} % held)" if mine else "")
        )
    search = np.median([a.fix["timing_ms"]["search"] for a in answers])
    http = np.median([a.http_ms for a in answers])
    return f"{', '.join(told)}; median search {search:.0f} ms, request to answer {http:.0f} ms"


def report(world: World, floors: list[MappedFloor], answers: list[Answer], judged: list[Judged]) -> dict[str, Any]:
    """Everything as plain JSON; infinite errors (a wrong floor) are null."""
    return {
        "building": world.building,
        "notes": world.notes,
        "maps": [
            {
                "floor": floor.name, "map_id": floor.map["id"], "sha256": floor.map["sha256"],
                "score": floor.map["score"], "hyperparameters": floor.map["hyperparameters"],
                "consistency": _verdicts(floor),
                "true_rmse_ut": None if floor.error_uT is None else _rms(floor.error_uT).tolist(),
                "true_within_2sd": None if floor.error_uT is None or floor.error_sd_uT is None
                else float(np.mean(np.abs(floor.error_uT) <= 2 * floor.error_sd_uT)),
            }
            for floor in floors
        ],
        "techniques": [
            {"technique": technique, "length_m": length_m, "covered_only": covered_only, **_finite(summary(chosen))}
            for covered_only in (False, True)
            for length_m in (None, *sorted({a.question.length_m for a in answers}))
            for technique in TECHNIQUES
            if (chosen := [e for e in judged if e.technique == technique and _among(e, length_m, covered_only)])
        ],
        "windows": [
            {
                "walk": a.question.walk, "length_m": a.question.length_m, "covered": a.question.covered,
                "true_floor": floors[a.question.floor].floor_id, "truth_m": a.question.truth_m.tolist(),
                "status": a.fix["status"], "reason": a.fix["reason"], "estimates": a.fix["estimates"],
                "posterior": a.fix["posterior"], "search_ms": a.fix["timing_ms"]["search"], "http_ms": a.http_ms,
            }
            for a in answers
        ],
    }  # fmt: skip


def absurdities(world: World, floors: list[MappedFloor], judged: list[Judged]) -> list[str]:
    """Why the result cannot be right; empty when it can. A known world is judged strictly, real walks hardly."""
    beliefs = [each for each in judged if each.technique == "posterior" and each.error_m is not None]
    if not beliefs:
        return ["no window was located"]
    if world.field_uT is None:
        return []
    found = []
    for floor in floors:
        if floor.error_uT is not None and float(np.max(_rms(floor.error_uT))) > 2.0:
            found.append(f"{floor.name}: the map is off by {_numbers(_rms(floor.error_uT).tolist(), '.1f')} uT RMS")
    held = sum(_held(each) for each in beliefs)
    if binom.cdf(held, len(beliefs), _STATED) < _CHANCE:
        found.append(f"the stated 95 % radius holds only {held} of {len(beliefs)} true positions")
    long = [each for each in beliefs if each.answer.question.length_m >= 10.0]
    if long and np.median([each.error_m for each in long if each.error_m is not None]) > 1.0:
        found.append("windows of 10 m and more are located worse than 1 m in the median")
    return found


def _held(each: Judged) -> bool:
    return each.error_m is not None and each.error_m <= each.radius_95_m


def _among(each: Judged, length_m: float | None, covered_only: bool) -> bool:
    question = each.answer.question
    return (length_m is None or question.length_m == length_m) and (question.covered or not covered_only)


def _verdicts(floor: MappedFloor) -> dict[str, int]:
    statuses = [each["status"] for each in floor.quality["surveys"].values()]
    return {status: statuses.count(status) for status in ("consistent", "inconsistent", "unjudged")}


def _rms(error: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(error), axis=0)))


def _quantile(errors: Array, q: float) -> float:
    """An observed value, so that an infinite error never mixes with a finite one."""
    return float(np.quantile(errors, q, method="inverted_cdf"))


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def _numbers(values: list[float], form: str) -> str:
    return " ".join(f"{value:{form}}" for value in values)


def _percent(share: float | np.floating[Any] | None) -> str:
    return "-" if share is None else f"{100 * share:.0f}"


def _metres(length_m: float | None) -> str:
    if length_m is None:
        return "-"
    return f"{length_m:.2f}" if np.isfinite(length_m) else "floor"
