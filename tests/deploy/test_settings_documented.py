"""docs/settings.md has every variable that is read, with its default, and none that is not."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.settings import Settings

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "settings.md").read_text()
ROWS = {
    name: default.strip()
    for names, default in re.findall(r"^\| (`[^|]*`[^|]*) \| ([^|]*) \|", TEXT, re.MULTILINE)
    for name in re.findall(r"`([A-Z][A-Z0-9_]+)`", names)
}
NAMED = set(re.findall(r"`((?:ISODYN|AWS|OTEL)_[A-Z0-9_]+)", TEXT))
FIELDS = {f"ISODYN_{name.upper()}": field for name, field in Settings.model_fields.items()}
UNITS = {"": 1, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
OF_LIBRARIES = {
    "AWS_SESSION_TOKEN", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY",
}  # fmt: skip
OF_DESKTOPS = {"DISPLAY", "WAYLAND_DISPLAY"}
OF_TESTS = {"ISODYN_TEST_POSTGRES_URL", "ISODYN_TEST_DATA"}
NOT_READ = {"AWS_PROFILE"}  # and said to be so


def read_in_code() -> Iterator[str]:
    """Every string that is the name of a variable, by its prefix or because it is looked up in the environment."""
    for path in (*ROOT.glob("app/**/*.py"), *ROOT.glob("workers/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield from re.findall(r"^(?:ISODYN|AWS|OTEL)_[A-Z0-9_]+$", node.value)
            if isinstance(node, ast.Call) and "environ" in ast.unparse(node.func):
                yield from (
                    each.value for each in node.args if isinstance(each, ast.Constant) and isinstance(each.value, str)
                )


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_every_setting_has_its_row_and_default(name: str) -> None:
    assert name in ROWS, f"docs/settings.md has no row for {name}"
    assert FIELDS[name].description
    default, told = FIELDS[name].default, ROWS[name].strip("`")
    if isinstance(default, bool):
        assert told == ("on" if default else "off")
    elif isinstance(default, (int, float)):
        number, _, unit = told.partition(" ")
        assert float(number.replace(",", "")) * UNITS[unit] == default
    elif default == "":
        assert told == "none"
    elif default is not None:
        assert told.removeprefix("./") == str(default)


def test_every_variable_the_code_reads_is_documented() -> None:
    assert set(read_in_code()) - OF_DESKTOPS - NAMED == set()


def test_nothing_documented_does_not_exist() -> None:
    assert {*ROWS, *NAMED} - set(FIELDS) - set(read_in_code()) - OF_LIBRARIES - OF_TESTS - NOT_READ == set()


def test_a_secret_may_come_as_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "isodyn_database_url").write_text("postgresql+psycopg://of-the-file/x\n")
    (tmp_path / "isodyn_port").write_text("1234")
    monkeypatch.setenv("ISODYN_PORT", "4321")
    monkeypatch.delenv("ISODYN_DATABASE_URL", raising=False)
    read = Settings(_secrets_dir=tmp_path)
    assert (read.database_url, read.port) == ("postgresql+psycopg://of-the-file/x", 4321)
