"""Migrations only add, so that the version before works on while the next one's schema is there already.

What may stand in `upgrade` is listed here; everything else is refused: dropping, renaming, changing types, constraints
on tables with rows, columns that must be filled but have no default, and indexes that stop writers.
"""

import ast
from pathlib import Path

import pytest

VERSIONS = Path(__file__).parents[2] / "migrations" / "versions"
BEFORE_THE_RULE = {"0001", "0002", "0003", "0004", "0005"}


def calls(function: ast.FunctionDef) -> list[ast.Call]:
    return [node for node in ast.walk(function) if isinstance(node, ast.Call)]


def named(call: ast.Call) -> str:
    return ast.unparse(call.func)


def faults(source: str) -> list[str]:
    """What the migration does that it may not."""
    tree = ast.parse(source)
    (upgrade,) = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "upgrade"]
    found = []
    here = calls(upgrade)
    batches = {item.optional_vars.id for node in ast.walk(upgrade) if isinstance(node, ast.With)
               for item in node.items if isinstance(item.optional_vars, ast.Name)}  # fmt: skip
    new_tables = {ast.literal_eval(call.args[0]) for call in here if named(call) == "op.create_table"}
    for call in here:
        subject, _, operation = named(call).rpartition(".")
        if subject not in {"op", "", *batches}:
            continue  # a type, a column: judged where it is used
        if operation == "add_column":
            found += _column_faults(call)
        elif operation == "create_index" and subject == "op":
            if ast.literal_eval(call.args[1]) not in new_tables:
                found.append("op.create_index on a table with rows: use migrations.steps.create_index, on its own")
        elif operation == "create_index":
            others = {named(each) for each in here} - {"create_index"}
            if others:
                found.append(f"create_index is a migration of its own, without {', '.join(sorted(others))}")
        elif operation not in {"create_table", "batch_alter_table"}:
            found.append(f"{named(call)} is not known to be safe while the version before runs")
    return found


def _column_faults(call: ast.Call) -> list[str]:
    (column,) = [argument for argument in call.args if isinstance(argument, ast.Call)]
    given = {keyword.arg: keyword.value for keyword in column.keywords}
    optional = "nullable" in given and ast.literal_eval(given["nullable"])
    if not optional and "server_default" not in given:
        return [
            f"{ast.unparse(column)}: the version before does not fill it; make it nullable, or give a server_default"
        ]
    if any("ForeignKey" in named(inner) for inner in calls_in(column)):
        return [f"{ast.unparse(column)}: checking a foreign key reads a whole table while writers wait"]
    return []


def calls_in(node: ast.AST) -> list[ast.Call]:
    return [inner for inner in ast.walk(node) if isinstance(inner, ast.Call)]


def revisions() -> list[Path]:
    return [path for path in sorted(VERSIONS.glob("*.py")) if path.name.split("_")[0] not in BEFORE_THE_RULE]


@pytest.mark.parametrize("path", revisions(), ids=lambda path: path.stem)
def test_a_migration_only_adds(path: Path) -> None:
    assert faults(path.read_text()) == []


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("op.drop_column('job', 'kind')", "not known to be safe"),
        ("op.alter_column('job', 'kind', new_column_name='sort')", "not known to be safe"),
        ("op.rename_table('job', 'task')", "not known to be safe"),
        ("op.execute('ALTER TABLE job DROP kind')", "not known to be safe"),
        ("op.create_foreign_key('f', 'job', 'floor', ['floor_id'], ['id'])", "not known to be safe"),
        ("op.add_column('job', sa.Column('x', sa.Integer(), nullable=False))", "server_default"),
        ("op.add_column('job', sa.Column('x', sa.Integer(), sa.ForeignKey('floor.id'), nullable=True))", "foreign key"),
        ("op.create_index('ix', 'job', ['kind'])", "migrations.steps.create_index"),
        ("create_index('ix', 'job', ['kind']); op.add_column('job', sa.Column('x', nullable=True))", "of its own"),
        ("with op.batch_alter_table('job') as job:\n        job.drop_column('kind')", "not known to be safe"),
    ],
)
def test_what_takes_away_or_stops_writers_is_noticed(step: str, said: str) -> None:
    (fault,) = faults(f"def upgrade():\n    {step}\n")
    assert said in fault
