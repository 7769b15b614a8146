"""A fault of ours is answered without its insides, and its traceback is in the log."""

import logging

import pytest
from fastapi import FastAPI
from sqlalchemy.exc import ProgrammingError
from starlette.testclient import TestClient

from app.api.problems import add_problem_handlers
from app.errors import CorruptArtefact, NotFound, Unavailable


@pytest.mark.parametrize(
    ("error", "status", "logged"),
    [
        (CorruptArtefact("a grid is damaged"), 500, True),
        (ProgrammingError("SELECT secret", {}, Exception("no such table")), 500, True),
        (NotFound("no floor x"), 404, False),
    ],
    ids=["damaged", "database", "not found"],
)
def test_a_fault_that_is_answered_is_in_the_log(
    caplog: pytest.LogCaptureFixture, error: Exception, status: int, logged: bool
) -> None:
    app = FastAPI()
    add_problem_handlers(app)

    @app.get("/broken")
    def broken() -> None:
        raise error

    with caplog.at_level(logging.ERROR):
        answer = TestClient(app).get("/broken")
    assert answer.status_code == status
    assert "secret" not in answer.text
    assert ("in broken" in caplog.text, "GET /broken failed" in caplog.text) == (logged, logged)


def test_what_cannot_be_reached_is_503_with_a_time_and_its_cause_only_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    app = FastAPI()
    add_problem_handlers(app)

    @app.get("/broken")
    def broken() -> None:
        raise Unavailable("the blob store cannot be reached", retry_after_s=6.2) from OSError("http://inner.host:9000")

    with caplog.at_level(logging.WARNING):
        answer = TestClient(app).get("/broken")
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "7")
    assert "inner.host" not in answer.text
    assert "inner.host" in caplog.text
