"""`/metrics`: what this process has counted, and what it sees of the installation."""

from hmac import compare_digest
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.security import HTTPAuthorizationCredentials
from prometheus_client import REGISTRY, CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

from app.api.auth import bearer, check_operator, recognised
from app.api.context import ContextDep
from app.api.problems import ERROR_RESPONSES
from app.services.installation_metrics import InstallationMetrics

__all__ = ["router"]

router = APIRouter(tags=["operations"])


async def _may_read(
    request: Request, context: ContextDep, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
) -> None:
    """The key of ISODYN_METRICS_KEY, or an admin's of whoever runs the installation."""
    secret = None if credentials is None else credentials.credentials
    wanted = context.settings.metrics_key
    if secret is not None and wanted is not None and compare_digest(secret.encode(), wanted.encode()):
        return
    request.state.identity = await recognised(context, secret, "admin")
    check_operator(request.state.identity)


@router.get(
    "/metrics",
    summary="Prometheus metrics",
    response_class=Response,
    responses={**ERROR_RESPONSES, 200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    dependencies=[Depends(_may_read)],
)
def metrics(context: ContextDep) -> Response:
    """In Prometheus' text format; nothing in it is of one organisation."""
    seen = CollectorRegistry()
    seen.register(InstallationMetrics(context.engine, context.settings.data_dir))
    return Response(generate_latest(REGISTRY) + generate_latest(seen), media_type=CONTENT_TYPE_LATEST)
