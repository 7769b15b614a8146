"""Is it alive, is it ready, how is it doing."""

from typing import Literal

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from sqlalchemy import text

from app.api.context import ContextDep

__all__ = ["router"]

router = APIRouter(tags=["operations"])


class Health(BaseModel):
    status: Literal["ok", "unavailable"]
    checks: dict[str, str] = {}


@router.get("/healthz", summary="The process is alive")
async def healthz() -> Health:
    """Answered by the event loop itself, however busy the threads are."""
    return Health(status="ok")


@router.get(
    "/readyz", summary="The process can serve", responses={503: {"model": Health, "description": "Not ready"}},
    response_model=Health,
)  # fmt: skip
def readyz(context: ContextDep) -> Response:
    """The database answers and the blob store can be written."""
    checks = {}
    try:
        with context.sessions() as session:
            session.execute(text("SELECT 1"))
        checks["database"] = "ok"
    except Exception as error:
        checks["database"] = type(error).__name__
    try:
        context.blobs.exists("0" * 64)
        checks["blobs"] = "ok"
    except Exception as error:
        checks["blobs"] = type(error).__name__
    ready = all(check == "ok" for check in checks.values())
    health = Health(status="ok" if ready else "unavailable", checks=checks)
    return JSONResponse(health.model_dump(), 200 if ready else 503)
