"""The dashboard and the alerts ask for what there is, and say it as Prometheus understands it."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from prometheus_client import REGISTRY
from prometheus_client.metrics_core import Metric
from sqlalchemy import Engine

import app.telemetry.metrics  # noqa: F401  (it registers them)
from app.services.installation_metrics import InstallationMetrics

DEPLOY = Path(__file__).parents[2] / "deploy"
RULES = DEPLOY / "prometheus" / "rules.yml"
OPERATIONS = DEPLOY.parent / "docs" / "operations.md"
NAME = re.compile(r"\b(?:isodyn|process|python)_[a-z_]+\b")
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count"), "info": ("_info",), "gauge": ("",)}
promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="no promtool: apt-get install prometheus")


@pytest.fixture
def series(engine: Engine, tmp_path: Path) -> dict[str, set[str]]:
    """The names that may be asked for, with the labels of those that have some now."""
    found: dict[str, set[str]] = {}
    metrics: list[Metric] = [*REGISTRY.collect(), *InstallationMetrics(engine, tmp_path).collect()]
    for metric in metrics:
        for suffix in SUFFIXES[metric.type]:
            found[metric.name + suffix] = {label for sample in metric.samples for label in sample.labels}
    return found


def asked() -> Iterator[str]:
    """Every expression of the dashboard and the alerts."""
    dashboard = json.loads((DEPLOY / "grafana" / "isodyn.json").read_text())
    for panel in dashboard["panels"]:
        yield from (target["expr"] for target in panel.get("targets", []))
    for group in yaml.safe_load(RULES.read_text())["groups"]:
        yield from (rule["expr"] for rule in group["rules"])


def test_what_is_asked_for_is_there(series: dict[str, set[str]]) -> None:
    expressions = list(asked())
    assert len(expressions) > 40
    for expression in expressions:
        names = set(NAME.findall(expression))
        assert names or "up{" in expression, expression
        assert names <= set(series), expression


def test_what_is_there_is_looked_at(series: dict[str, set[str]]) -> None:
    wanted = {name for expression in asked() for name in NAME.findall(expression)}
    families = {re.sub(r"_(total|bucket|sum|count|info)$", "", name) for name in wanted}
    ours = {re.sub(r"_(total|bucket|sum|count|info)$", "", name) for name in series if name.startswith("isodyn_")}
    assert ours == families & ours


def test_every_alert_has_its_place_in_the_runbook() -> None:
    alerts = [rule["alert"] for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
    headings = re.findall(r"^### (Isodyn\w+)$", OPERATIONS.read_text(), re.MULTILINE)
    assert sorted(headings) == sorted(alerts)


@promtool
@pytest.mark.parametrize("command", [["check", "rules", str(RULES)]])
def test_prometheus_understands_the_rules(command: list[str]) -> None:
    subprocess.run(["promtool", *command], check=True)


@promtool
def test_prometheus_understands_the_configuration(tmp_path: Path) -> None:
    for name in ("prometheus.yml", "rules.yml"):
        shutil.copy(DEPLOY / "prometheus" / name, tmp_path)
    (tmp_path / "metrics_key").write_text("isd_metrics")
    subprocess.run(["promtool", "check", "config", str(tmp_path / "prometheus.yml")], check=True)
