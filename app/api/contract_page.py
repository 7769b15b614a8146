"""`/docs`: the contract to read and to try, by Swagger UI, whose files this server has: no network is needed."""

from functools import cache
from importlib.resources import files

from fastapi import APIRouter, Request, Response

from app.api.caching import pointer_to
from app.errors import NotFound

__all__ = ["router"]

router = APIRouter(include_in_schema=False)

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)  # Swagger UI styles its elements by attributes
_PAGE = b"""<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><title>Isodyn: the contract</title><link rel="stylesheet" href="docs/swagger-ui.css"></head>
<body><div id="contract"></div><script src="docs/swagger-ui-bundle.js"></script><script src="docs/start.js"></script>
<noscript>The contract as one document: <a href="openapi.json">openapi.json</a></noscript></body>
</html>
"""
_START = b"""SwaggerUIBundle({
  url: "openapi.json", dom_id: "#contract", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout",
});
"""
_TYPES = {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css", "start.js": "text/javascript"}


@router.get("/docs")
async def page(request: Request) -> Response:
    answer = pointer_to(request, _PAGE, "text/html")
    answer.headers["Content-Security-Policy"] = _POLICY
    return answer


@router.get("/docs/{name}")
def part(name: str, request: Request) -> Response:
    if name not in _TYPES:
        raise NotFound("there is no such file")
    return pointer_to(request, _content(name), _TYPES[name])


@cache
def _content(name: str) -> bytes:
    return _START if name == "start.js" else files("fastapi_offline").joinpath("static", name).read_bytes()
