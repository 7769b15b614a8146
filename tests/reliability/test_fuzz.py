"""Fuzzing, bounded: `make fuzz` sends 50,000 requests and 10,000 surveys and windows (docs/reliability.md)."""

from pathlib import Path

import httpx

from tests.reliability.fuzz import fuzz_inputs, mapped_floor, rss_mib
from tests.reliability.installation import KEY, installation


def test_surveys_and_windows_that_are_almost_right(tmp_path: Path) -> None:
    with installation("sqlite", tmp_path, 0.0) as site:
        site.start(apis=1, workers=1)
        with httpx.Client(base_url=site.addresses[0], headers={"Authorization": f"Bearer {KEY}"}, timeout=120) as http:
            statuses = fuzz_inputs(http, mapped_floor(http), 80)
        assert site.apis[0].restarts == 0, site.logs()
        assert rss_mib(site.apis[0].pid) < 2000
    for expected in ("surveys 202", "surveys 422", "locate 200", "locate 422"):
        assert statuses[expected], statuses
