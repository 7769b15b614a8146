"""The fault campaign, bounded: `make campaign` runs the long one (docs/reliability.md)."""

from pathlib import Path

import pytest

from tests.reliability.campaign import run_campaign
from tests.reliability.installation import BackEnd, installation

UPLOADS = 12


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[int, str]:
    """The last maps of an installation that nothing happens to."""
    with installation("sqlite", tmp_path_factory.mktemp("undisturbed"), 0.0) as site:
        site.start(apis=1, workers=1)
        seen = run_campaign(site, UPLOADS, auto_build=False)
    assert not seen.wrong
    assert len(set(seen.maps.values())) == len(seen.maps)
    return seen.maps


@pytest.mark.timeout(600)
@pytest.mark.parametrize("back_end", ["sqlite", pytest.param("postgres", marks=[pytest.mark.postgres, pytest.mark.s3])])
def test_nothing_acknowledged_is_lost(back_end: BackEnd, undisturbed: dict[int, str], tmp_path: Path) -> None:
    with installation(back_end, tmp_path, outage_s=3.0) as site:
        site.start(apis=1 if back_end == "sqlite" else 2, workers=2)
        seen = run_campaign(site, UPLOADS, every_s=2.0, pace_s=1.5)
        print(seen.told(), site.logs(), sep="\n")
        assert len(seen.acknowledged) == UPLOADS
        assert len(seen.faults) >= 4
        assert seen.looks > 5
        assert not seen.lost
        assert not seen.wrong
        assert not seen.unended
        assert set(seen.jobs) == {"successful"}
        assert seen.maps == undisturbed
        site.doctor()
