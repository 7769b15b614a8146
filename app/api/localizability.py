"""How well windows will be located on a map, from the map alone."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from app.api.auth import Reading
from app.api.caching import immutable
from app.api.context import ContextDep
from app.api.maps import ready_map
from app.api.models import Id, Metres
from app.api.problems import ERROR_RESPONSES
from app.api.windows import AskedWindowDep, Knowledge
from app.services.summarise_localizability import JudgedPoint, LocalizabilitySummary, summarise_localizability
from app.viewer.layers import nearest_height

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["maps"], responses=ERROR_RESPONSES)


class PercentilesView(BaseModel):
    p5: float
    p25: float
    p50: float
    p75: float
    p95: float


class JudgedPointView(BaseModel):
    """A measured cell; `expected_error_m` is null where no window that ends there is on the measured map."""

    position_m: list[float]
    gradient_ut_per_m: float
    expected_error_m: float | None


class LocalizabilityView(BaseModel):
    """Of the measured cells at one height. Expected errors are horizontal, rms over errors and directions.

    Shares are of the measured area; where no window could be judged counts as not within anything.
    """

    map_sha256: str
    components: list[str]
    height_m: float
    window_m: float
    noise_ut: float
    bias: Knowledge
    heading: Knowledge
    measured_area_m2: float
    gradient_ut_per_m: Annotated[
        dict[str, PercentilesView], Field(description="norms of the derivative with x and y, and in total")
    ]
    best: Annotated[JudgedPointView | None, Field(description="where the total gradient is largest")]
    worst: Annotated[JudgedPointView | None, Field(description="where the total gradient is smallest")]
    expected_error_m: PercentilesView | None
    judged_share: float
    share_within_1_m: float
    share_within_5_m: float


@router.get(
    "/maps/{map_id}/localizability",
    response_model=LocalizabilityView,
    summary="How well windows will be located, before anybody asks",
)
def get_localizability(
    map_id: Id,
    request: Request,
    context: ContextDep,
    identity: Reading,
    asked: AskedWindowDep,
    height_m: Annotated[
        Metres | None, Query(description="the nearest of the map's heights, within half a metre, is judged")
    ] = None,
) -> Response:
    """Gradients of the field, and the least error (Cramer-Rao) of windows of this length and sensor.

    The picture of it is the layer `expected_error` of the heat map, which takes the same parameters. What it
    cannot tell: whether a place far away looks alike; the answers of `locate` do.
    """
    ready = ready_map(context, identity, map_id)
    grid, k = ready.grid, nearest_height(ready.grid, height_m)

    def make() -> bytes:
        summary = summarise_localizability(grid, k, asked.model())
        told = {"map_sha256": ready.sha256, "components": list(grid.component_names)}
        return LocalizabilityView.model_validate(told | asked._asdict() | _shown(summary)).model_dump_json().encode()

    tag = ready.tag("localizability", *asked, k)
    return immutable(request, tag, make, "application/json")


def _shown(summary: LocalizabilitySummary) -> dict[str, object]:
    same = (
        "height_m", "measured_area_m2", "expected_error_m", "judged_share", "share_within_1_m", "share_within_5_m",
    )  # fmt: skip
    return {
        **{name: getattr(summary, name) for name in same},
        "gradient_ut_per_m": summary.gradient_uT_per_m,
        "best": _shown_point(summary.best),
        "worst": _shown_point(summary.worst),
    }


def _shown_point(point: JudgedPoint | None) -> dict[str, object] | None:
    if point is None:
        return None
    return {
        "position_m": list(point.position_m),
        "gradient_ut_per_m": point.gradient_uT_per_m,
        "expected_error_m": point.expected_error_m,
    }
