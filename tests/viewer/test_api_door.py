"""The API behind the page's session: what goes through, with which key, and what does not."""

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.routing import Route

from app.viewer.page import ViewerApp


async def tell(request: Request) -> JSONResponse:
    """An API that says what reached it."""
    return JSONResponse({
        "method": request.method, "path": request.scope["path"], "query": request.url.query,
        "authorization": request.headers.get("authorization"), "cookie": request.headers.get("cookie"),
        "body": (await request.body()).decode(),
    })  # fmt: skip


@pytest.fixture
def running(serve, keys, source):
    methods = ["GET", "POST", "PATCH", "DELETE"]
    api = Starlette(routes=[Route("/v1/{rest:path}", tell, methods=methods)])
    return serve(ViewerApp(keys, source, api=api))


def test_a_request_goes_on_with_the_sessions_key_and_without_the_cookie(running):
    with running.client() as client:
        headers = {"Cookie": running.cookie("north-key"), "Authorization": "Bearer another"}
        told = client.post("/view/v1/floors/a%20b/locate?x=1", content=b"{}", headers=headers).json()
    assert told == {"method": "POST", "path": "/v1/floors/a b/locate", "query": "x=1", "body": "{}",
                    "authorization": "Bearer north-key", "cookie": None}  # fmt: skip


@pytest.mark.parametrize("cookie", [None, "isodyn_view=made-up", "isodyn_view=", 'a=";'])
def test_nobody_gets_through_without_a_session(running, cookie):
    with running.client() as client:
        headers = {"Cookie": cookie} if cookie else {}
        assert client.get("/view/v1/buildings", headers=headers).status_code == 401


@pytest.mark.parametrize("others", ['a={"b": 1}; ', "a/b=1; "])
def test_cookies_of_other_pages_on_the_host_close_no_door(running, others):
    with running.client() as client:
        headers = {"Cookie": others + running.cookie("north-key")}
        assert client.get("/view/v1/buildings", headers=headers).status_code == 200


def test_a_path_may_be_written_with_escapes(running):
    with running.client() as client:
        headers = {"Cookie": running.cookie("north-key")}
        assert client.get("/view/%76%31/buildings", headers=headers).json()["path"] == "/v1/buildings"


@pytest.mark.parametrize("method", ["POST", "PATCH", "DELETE"])
@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_another_sites_page_changes_nothing(running, method, origin):
    headers = {"Cookie": running.cookie("north-key")} | ({"Origin": origin} if origin else {})
    with running.client() as client:
        del client.headers["origin"]
        assert client.request(method, "/view/v1/surveys/a", headers=headers).status_code == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_sites_page_reads_nothing(running, site):
    headers = {"Cookie": running.cookie("north-key"), "Sec-Fetch-Site": site}
    with running.client() as client:
        assert client.get("/view/v1/buildings", headers=headers).status_code == 403
        assert client.get("/view/v1/buildings", headers=headers | {"Sec-Fetch-Site": "same-origin"}).status_code == 200


def test_a_revoked_key_and_a_signed_out_session_get_no_further(running, keys):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        assert client.get("/view/v1/buildings", headers=cookie).status_code == 200
        client.post("/view/sign-out", headers=cookie)
        assert client.get("/view/v1/buildings", headers=cookie).status_code == 401


def test_only_the_api_is_behind_the_door(running):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        for path in ("/view/v1/../metrics", "/view/metrics", "/view/v1"):
            assert client.get(path, headers=cookie).status_code == 404
