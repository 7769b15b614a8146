"""What is looked up when somebody asks for metrics, against rows; and what is said when there is no database."""

from datetime import timedelta
from pathlib import Path

from sqlalchemy import Engine
from sqlalchemy.orm import Session, sessionmaker

from app.db.engine import create_database_engine
from app.db.tables import Job, Organisation, Worker, utc_now
from app.services.installation_metrics import InstallationMetrics


def figures(engine: Engine, folder: Path) -> dict[str, float]:
    """Every sample, by name and label."""
    return {
        " ".join([sample.name, *sample.labels.values()]): sample.value
        for metric in InstallationMetrics(engine, folder).collect()
        for sample in metric.samples
    }


def test_jobs_and_workers_are_counted_by_their_rows(
    engine: Engine, sessions: sessionmaker[Session], tmp_path: Path
) -> None:
    before = figures(engine, tmp_path)
    assert (before["isodyn_workers_live"], before["isodyn_jobs_oldest_waiting_seconds"]) == (0, 0)
    now = utc_now()
    with sessions.begin() as session:
        owner = Organisation(name="counted")
        session.add(owner)
        session.flush()
        for k, (kind, status, age_s) in enumerate(
            [("rebuild", "accepted", 50), ("rebuild", "accepted", 10), ("build", "running", 99), ("build", "failed", 0)]
        ):
            session.add(
                Job(organisation_id=owner.id, floor_id="f", kind=kind, workflow_id=f"counted:{k}", status=status,
                    created_at=now - timedelta(seconds=age_s))
            )  # fmt: skip
        session.add(Worker(id="a", state="live", beat=now - timedelta(seconds=20)))
        session.add(Worker(id="b", state="live", beat=now))
        session.add(Worker(id="c", state="dead", beat=now - timedelta(days=1)))
        session.add(Worker(id="killed, with nobody there to see it", state="live", beat=now - timedelta(minutes=10)))
    after = figures(engine, tmp_path)
    assert after["isodyn_jobs_waiting rebuild"] == 2
    assert after["isodyn_jobs_waiting build"] == 0
    assert after["isodyn_jobs_running build"] == 1
    assert 50 <= after["isodyn_jobs_oldest_waiting_seconds"] < 110
    assert after["isodyn_workers_live"] == 2
    assert 600 <= after["isodyn_workers_oldest_beat_seconds"] < 660
    assert after["isodyn_database_up"] == 1
    assert 0 < after["isodyn_disk_free_bytes"] < after["isodyn_disk_size_bytes"]


def test_a_lost_database_is_a_figure_not_a_failure(tmp_path: Path) -> None:
    engine = create_database_engine("postgresql+psycopg://nobody@127.0.0.1:1/none")
    told = figures(engine, tmp_path)
    assert told["isodyn_database_up"] == 0
    assert "isodyn_disk_free_bytes" in told
    assert "isodyn_jobs_waiting rebuild" not in told


def test_a_lost_disk_takes_no_other_figure_with_it(engine: Engine, tmp_path: Path) -> None:
    told = figures(engine, tmp_path / "unmounted")
    assert told["isodyn_database_up"] == 1
    assert "isodyn_disk_free_bytes" not in told
