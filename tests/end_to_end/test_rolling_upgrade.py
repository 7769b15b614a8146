"""The version before and this one side by side on this one's schema: walks come through both, and all are mapped."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from conftest import Server

ROOT = Path(__file__).parents[2]
VERSIONS = Path("migrations", "versions")


def git(*arguments: str) -> str | None:
    """What git says; None where there is no history (an archive of the source)."""
    if shutil.which("git") is None:
        return None
    told = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True)
    return told.stdout.strip() if told.returncode == 0 else None


def before_the_newest_migration() -> str | None:
    newest = sorted((ROOT / VERSIONS).glob("*.py"))[-1].relative_to(ROOT)
    added = git("log", "-1", "--diff-filter=A", "--format=%H", "--", str(newest))
    return git("rev-parse", "--verify", f"{added}^" if added else "HEAD") if added is not None else None


@pytest.fixture(scope="module")
def version_before(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Its code in a folder of its own."""
    commit = before_the_newest_migration()
    if commit is None:
        pytest.skip("the version before is in git's history, which is not here (an archive, or a shallow clone)")
    folder = tmp_path_factory.mktemp("before") / "code"
    assert git("worktree", "add", "--detach", str(folder), commit) is not None
    yield folder
    git("worktree", "remove", "--force", str(folder))


@pytest.mark.slow
def test_walks_through_both_versions_are_all_mapped(
    server_of: "type[Server]",
    version_before: Path,
    database_url: str,
    tmp_path: Path,
    walk_csv: Callable[[int], bytes],
) -> None:
    servers: list[Any] = []
    for name in ("old", "new"):
        folder = tmp_path / name
        folder.mkdir()
        server = server_of(folder, database_url)
        server.environment["ISODYN_BLOB_URL"] = f"file://{tmp_path / 'blobs'}"
        servers.append(server)
    old, new = servers
    old.environment |= {"PYTHONSAFEPATH": "1", "PYTHONPATH": str(version_before)}
    try:
        old.start()
        floors = [old.new_floor() for _ in range(3)]
        first = old.http.post(f"/v1/floors/{floors[0]}/surveys", content=walk_csv(1))
        assert first.status_code == 202, first.text
        new.start()  # migrates; the old one goes on
        turns = [(server, floor, seed) for seed in range(2, 6) for floor in floors for server in (old, new)]
        with ThreadPoolExecutor(4) as pool:
            answers = list(pool.map(lambda turn: upload(*turn, walk_csv), turns))
        assert old.stop() == 0  # its worker leaves what it has not finished
        jobs = {answer["job"]["id"] for answer in answers}
        assert {new.wait_for(job)["status"] for job in jobs} == {"successful"}
        for floor in floors:
            surveys = {row["id"] for row in new.http.get(f"/v1/floors/{floor}/surveys?limit=100").json()["items"]}
            (active,) = [
                row for row in new.http.get(f"/v1/floors/{floor}/maps?limit=100").json()["items"] if row["active"]
            ]
            assert len(surveys) == (9 if floor == floors[0] else 8)
            assert set(active["survey_ids"]) == surveys
    finally:
        for server in servers:
            server.http.close()
            server.kill()


def upload(server: Any, floor: str, seed: int, walk_csv: Callable[[int], bytes]) -> dict[str, Any]:
    """A walk of its own by each server."""
    walk = walk_csv(2 * seed + (server.folder.name == "new"))
    answer = server.http.post(f"/v1/floors/{floor}/surveys", content=walk)
    assert answer.status_code == 202, answer.text
    told: dict[str, Any] = answer.json()
    return told
