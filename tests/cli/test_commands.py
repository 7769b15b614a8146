"""The commands as a user types them."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import select, update
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.blobs import open_blob_store
from app.cli import main
from app.cli.doctor import examine
from app.db.engine import create_database_engine
from app.db.tables import Calibration, Key, Organisation, utc_now
from app.errors import InvalidInput
from app.main import first_start
from app.settings import Settings

runner = CliRunner()


@pytest.fixture
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in list(os.environ):
        if name.startswith("ISODYN_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("ISODYN_DATA_DIR", str(tmp_path / "var"))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path / "var"


def test_every_command_explains_itself() -> None:
    commands = (
        "serve",
        "worker",
        "demo",
        "ingest",
        "calibrate",
        "locate",
        "export",
        "view",
        "evaluate",
        "keys",
        "audit",
        "doctor",
        "openapi",
        "backup",
        "restore",
        "clean",
    )
    for command in commands:
        result = runner.invoke(main, [command, "--help"])
        assert result.exit_code == 0, result.output


def test_keys_are_made_shown_once_listed_and_revoked(data_dir: Path) -> None:
    made = runner.invoke(main, ["keys", "create", "robot", "--scope", "locate", "--scope", "map:read"])
    assert made.exit_code == 0, made.output
    key = made.output.strip()
    assert key.startswith("isd_")
    listed = runner.invoke(main, ["keys", "list"])
    assert "robot" in listed.output
    assert "locate, map:read" in listed.output
    assert key not in listed.output
    assert key.encode() not in (data_dir / "isodyn.db").read_bytes()
    key_id = next(word for word in listed.output.replace("│", " ").split() if word.count("-") == 4 and len(word) == 36)
    assert runner.invoke(main, ["keys", "revoke", key_id]).exit_code == 0
    assert runner.invoke(main, ["keys", "revoke", "nobody"]).exit_code == 2


def test_keys_end_are_rotated_and_all_of_it_is_in_the_log(data_dir: Path) -> None:
    made = runner.invoke(main, ["keys", "create", "robot", "--scope", "locate", "--expires", "90d"])
    assert made.exit_code == 0, made.output
    (line,) = runner.invoke(main, ["audit"]).output.splitlines()
    row = json.loads(line)
    assert (row["action"], row["organisation"], row["key_id"]) == ("key.create", "default", None)
    assert row["actor"].startswith("command line")
    rotated = runner.invoke(main, ["keys", "rotate", row["object_id"], "--overlap", "90m"])
    assert rotated.exit_code == 0, rotated.output
    assert rotated.stdout.startswith("isd_")
    assert rotated.stdout != made.stdout
    assert "takes the place of" in rotated.stderr
    rows = [json.loads(each) for each in runner.invoke(main, ["audit", "--since", "1h"]).output.splitlines()]
    assert [each["action"] for each in rows] == ["key.create", "key.create", "key.rotate"]
    assert rows[-1]["details"]["new_key_id"] == rows[1]["object_id"]
    of_one = runner.invoke(main, ["audit", "--object", row["object_id"], "--action", "key.rotate"]).output.splitlines()
    assert len(of_one) == 1
    assert runner.invoke(main, ["audit", "--organisation", "another"]).output == ""
    assert runner.invoke(main, ["audit", "--since", "2099-01-01"]).output == ""
    for wrong in (["--expires", "soon"], ["--expires", "2020-01-01"], ["--building", "nowhere"]):
        assert runner.invoke(main, ["keys", "create", "x", "--scope", "locate", *wrong]).exit_code == 2


def test_an_unknown_scope_is_refused_with_the_known_ones(data_dir: Path) -> None:
    result = runner.invoke(main, ["keys", "create", "x", "--scope", "everything"])
    assert result.exit_code == 2
    assert "map:read" in result.output


def test_the_doctor_finds_nothing_wrong_with_a_fresh_start(data_dir: Path) -> None:
    assert runner.invoke(main, ["doctor"]).exit_code == 0
    runner.invoke(main, ["keys", "create", "x", "--scope", "locate"])
    result = runner.invoke(main, ["doctor"])
    assert result.exit_code == 0, result.output
    assert "schema" in result.output


def test_the_doctor_says_what_is_wrong_and_what_to_do(data_dir: Path) -> None:
    data_dir.mkdir()
    (data_dir / "isodyn.db").write_bytes(b"this is not a database" * 100)
    result = runner.invoke(main, ["doctor"])
    assert result.exit_code == 1
    assert "wrong" in result.output
    broken = [finding for finding in examine(Settings()) if finding.ok is False]
    assert [finding.what for finding in broken] == ["database"]


def test_the_doctor_notices_an_unreachable_database(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ISODYN_DATABASE_URL", "postgresql+psycopg://nobody@127.0.0.1:1/none?connect_timeout=2")
    findings = {finding.what: finding for finding in examine(Settings())}
    assert findings["database"].ok is False


def test_a_backup_is_made_restored_looked_at_and_cleaned(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert runner.invoke(main, ["backup", str(tmp_path)]).exit_code == 2, "there is nothing"
    first_start(Settings())
    made = runner.invoke(main, ["backup", str(tmp_path)])
    assert made.exit_code == 0, made.output
    (archive,) = tmp_path.glob("isodyn-*.zip")
    keys = runner.invoke(main, ["keys", "list"]).output
    refused = runner.invoke(main, ["restore", str(archive)])
    assert refused.exit_code == 2
    assert "not empty" in refused.output
    monkeypatch.setenv("ISODYN_DATA_DIR", str(tmp_path / "new"))
    done = runner.invoke(main, ["restore", str(archive)])
    assert done.exit_code == 0, done.output
    assert runner.invoke(main, ["keys", "list"]).output == keys
    blobs = open_blob_store(Settings().resolved_blob_url)
    sha256 = blobs.put(b"orphan")
    file = tmp_path / "new" / "blobs" / sha256[:2] / sha256[2:4] / sha256
    assert "0 blobs deleted" in runner.invoke(main, ["clean"]).output
    os.utime(file, (0, 0))
    looked = runner.invoke(main, ["doctor", "--deep"])
    assert looked.exit_code == 0, looked.output
    assert "isodyn clean" in looked.output
    assert "1 blobs would be deleted, 6 bytes" in runner.invoke(main, ["clean", "--dry-run"]).output
    assert "1 blobs deleted, 6 bytes" in runner.invoke(main, ["clean", "--older-than", "2d"]).output
    assert not file.exists()
    for wrong in ("5m", "a day", "-1h"):
        assert runner.invoke(main, ["clean", "--older-than", wrong]).exit_code == 2


def test_a_deep_look_finds_damaged_and_missing_blobs(data_dir: Path) -> None:
    first_start(Settings())
    blobs = open_blob_store(Settings().resolved_blob_url)
    damaged, missing = blobs.put(b"damaged"), "0" * 64
    engine = create_database_engine(Settings().resolved_database_url)
    with Session(engine) as session, session.begin():
        owner = session.scalars(select(Organisation.id)).one()
        for version, sha256 in enumerate((damaged, missing)):
            session.add(Calibration(
                organisation_id=owner, device="d", version=version, method="m", model={}, fit={}, reference={},
                samples_sha256=sha256, measured_at=utc_now(),
            ))  # fmt: skip
    engine.dispose()
    (data_dir / "blobs" / damaged[:2] / damaged[2:4] / damaged).write_bytes(b"Damaged")
    result = runner.invoke(main, ["doctor", "--deep"])
    assert result.exit_code == 1
    assert "damaged blobs" in result.output
    assert "missing blobs" in result.output
    assert "calibration.samples_sha256" in result.output.replace("\n", "")
    assert runner.invoke(main, ["doctor"]).exit_code == 0
    away = (data_dir / "blobs").rename(data_dir / "away")
    for mounted in (False, True):  # the folder is gone, and the empty one where its disk is mounted
        for command in (["doctor"], ["clean"], ["clean", "--dry-run"], ["backup", str(data_dir / "b.zip")]):
            result = runner.invoke(main, command)
            said = " ".join(result.output.replace("│", " ").split())
            assert result.exit_code == (1 if command == ["doctor"] else 2), said
            assert "ISODYN_BLOB_URL" in said, said
            assert (data_dir / "blobs").exists() is mounted
        if not mounted:
            (data_dir / "blobs").mkdir()
    assert not list((data_dir / "blobs").iterdir())
    assert away.is_dir()


def test_openapi_is_written(data_dir: Path, tmp_path: Path) -> None:
    result = runner.invoke(main, ["openapi", "--output", str(tmp_path / "openapi.json")])
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "openapi.json").read_text())
    assert "/v1/buildings/{building_id}/locate" in document["paths"]
    assert document["components"]["schemas"]["LocateBody"]["examples"]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("PORT", "99999", "ISODYN_PORT"), ("BLOB_URL", "s3://", "s3"), ("DATABASE_URL", "mysql://x/y", "mysql")],
)
def test_a_wrong_setting_is_one_sentence(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str, said: str
) -> None:
    monkeypatch.setenv(f"ISODYN_{name}", value)
    result = runner.invoke(main, ["serve", *([] if name == "PORT" else ["--port", "18399"])])
    assert result.exit_code == 2, result.output
    assert said in result.output
    assert "Traceback" not in result.output


def test_a_taken_port_is_one_sentence(data_dir: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = runner.invoke(main, ["serve", "--port", str(taken.getsockname()[1])])
    assert result.exit_code == 2
    assert "--port" in result.output


def test_a_revoked_admin_key_stops_the_start_with_a_sentence(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ISODYN_ADMIN_KEY", "isd_wanted")
    first_start(Settings())
    with create_database_engine(Settings().resolved_database_url).begin() as connection:
        connection.execute(update(Key).values(revoked_at=utc_now()))
    with pytest.raises(InvalidInput, match="revoked"):
        first_start(Settings())


def test_an_unreachable_server_is_one_sentence(data_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "walk.csv").write_text("t_s\n")
    arguments = ["ingest", "floor", str(tmp_path / "walk.csv"), "--key", "isd_x", "--url", "http://127.0.0.1:1"]
    result = runner.invoke(main, arguments)
    assert result.exit_code == 2
    assert "isodyn serve" in result.output


def test_the_web_process_starts_without_scikit_learn_viser_or_magpylib() -> None:
    """Start-up stays quick: what few requests need is loaded when one comes."""
    code = (
        "import sys, app.main; print([m for m in ('sklearn', 'viser', 'magpylib', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_setting_is_documented() -> None:
    readme = Path(__file__).parents[2] / "docs" / "settings.md"
    text = readme.read_text()
    for name in Settings.model_fields:
        assert f"ISODYN_{name.upper()}" in text, name
