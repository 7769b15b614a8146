"""The OpenAPI document against the service, by property-based contract testing (schemathesis)."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from app.main import create_app, first_start
from app.settings import Settings

KEY = "isd_contract-tests"
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder: Path = tmp_path_factory.mktemp("contract")
    options = Settings(data_dir=folder, database_url=None, blob_url=None, admin_key=KEY, max_window_samples=50)
    first_start(options)
    app = create_app(options)
    yield app
    app.state.context.engine.dispose()


def check_contract(schema: Any, key: str, examples: int, seed: int = 0) -> dict[str, int]:
    """Send generated requests, fitting and not fitting the description, to every operation: calls by operation."""
    calls: dict[str, int] = {}
    for operation in schema.get_all_operations():
        described = operation.ok()
        if described.path.endswith("/events"):  # a stream: tests/api/test_access.py reads it to its end
            continue
        for mode in schemathesis.GenerationMode:

            @hypothesis.seed(seed)
            @settings(
                max_examples=examples,
                deadline=None,
                database=None,
                suppress_health_check=list(HealthCheck),
                phases=[Phase.explicit, Phase.generate],
            )
            @given(case=described.as_strategy(generation_mode=mode))
            def holds(case: Any) -> None:
                calls[case.operation.label] = calls.get(case.operation.label, 0) + 1
                case.call_and_validate(headers={"Authorization": f"Bearer {key}"}, checks=CHECKS, timeout=120)

            with suppress(Unsatisfiable):  # nothing to get wrong in a request without parameters
                holds()
    return calls


def test_the_service_keeps_its_contract(app: Any) -> None:
    calls = check_contract(schemathesis.openapi.from_asgi("/openapi.json", app), KEY, examples=3)
    assert len(calls) >= 30, calls
