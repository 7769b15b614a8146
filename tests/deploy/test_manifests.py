"""Image, compose file and manifests: valid by their own schemas, and of one mind with the program and each other."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from sqlalchemy.pool import QueuePool

from app.db.engine import create_database_engine
from app.settings import Settings

ROOT = Path(__file__).parents[2]
KUBERNETES = ROOT / "deploy" / "kubernetes"
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((ROOT / "deploy" / "compose" / "compose.yml").read_text())
SECRETS = ROOT / "deploy" / "compose" / "make-secrets.sh"
OURS = ("migrate", "api", "worker")
VARIABLES = {f"ISODYN_{name.upper()}" for name in Settings.model_fields}


def objects() -> Iterator[dict[str, Any]]:
    for path in sorted(KUBERNETES.glob("*.yaml")):
        if path.name != "kustomization.yaml":
            yield from yaml.safe_load_all(path.read_text())


def workloads() -> list[dict[str, Any]]:
    return [each for each in objects() if each["kind"] in ("Deployment", "Job")]


@pytest.mark.parametrize("each", list(objects()), ids=lambda each: f"{each['kind']}-{each['metadata']['name']}")
def test_kubernetes_understands_it(each: dict[str, Any]) -> None:
    kubernetes_validate.validate(each, "1.31", strict=True)


def test_the_base_has_every_file_but_the_example() -> None:
    listed = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"]
    there = {path.name for path in KUBERNETES.glob("*.yaml")} - {"kustomization.yaml", "secret.example.yaml"}
    assert set(listed) == there


@pytest.mark.parametrize("each", workloads(), ids=lambda each: each["metadata"]["name"])
def test_every_pod_keeps_to_the_restricted_standard(each: dict[str, Any]) -> None:
    pod = each["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"]
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert container["securityContext"]["readOnlyRootFilesystem"]
    assert container["securityContext"]["allowPrivilegeEscalation"] is False
    assert container["resources"]["limits"]["memory"]
    mounted = {mount["mountPath"] for mount in container["volumeMounts"]}
    assert mounted == {"/tmp", *re.findall(r'"(/[a-z/]+)"', re.search(r"VOLUME (.*)", DOCKERFILE)[1])}  # type: ignore[index]
    assert f"USER {pod['securityContext']['runAsUser']}:" in DOCKERFILE
    ports = {port["name"] for port in container.get("ports", [])}
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        asked = container.get(probe, {})
        assert asked.get("httpGet", asked.get("tcpSocket", {"port": None}))["port"] in {None, *ports}


def test_every_variable_that_is_set_exists() -> None:
    text = "\n".join(path.read_text() for path in (ROOT / "deploy").rglob("*") if path.suffix in (".yaml", ".yml"))
    named = set(re.findall(r"\b(ISODYN_[A-Z_]+)\b(?!_FILE)", text + DOCKERFILE))
    assert named - {"ISODYN_SITE"} <= VARIABLES  # the proxy's


@pytest.mark.parametrize("name", OURS)
def test_compose_runs_the_image_without_rights_and_bounded(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["read_only"]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert set(service["secrets"]) <= set(COMPOSE["secrets"])


def test_every_image_is_pinned_and_names_no_host() -> None:
    images = [each["image"] for each in COMPOSE["services"].values()]
    images += re.findall(r"^ARG PYTHON=(.*)", DOCKERFILE, re.MULTILINE)
    for image in set(images) - {"isodyn"}:
        assert re.search(r"\d+\.\d+", image), image
        assert "." not in image.split("/")[0] or "/" not in image, image


def test_the_database_takes_all_that_the_guide_scales_to() -> None:
    """As `--scale api=3 --scale worker=2` does, and as many again while they are replaced."""
    allowed = int(COMPOSE["services"]["db"]["command"][-1].removeprefix("max_connections="))
    engine = create_database_engine("postgresql+psycopg://nobody@127.0.0.1:1/none")
    assert isinstance(engine.pool, QueuePool)
    of_web_process = engine.pool.size() + engine.pool._max_overflow
    of_worker = of_web_process + 20  # of the job engine
    assert 2 * (3 * of_web_process + 2 * of_worker) < allowed


def test_the_secrets_made_are_those_asked_for(tmp_path: Path) -> None:
    script = shutil.copy(SECRETS, tmp_path)
    subprocess.run(["sh", script], check=True, stdout=subprocess.DEVNULL)
    made = tmp_path / "secrets"
    assert {path.name for path in made.iterdir()} == set(COMPOSE["secrets"])
    assert made.stat().st_mode & 0o077 == 0
    read = Settings(_secrets_dir=made)
    assert read.database_url is not None
    assert (made / "postgres_password").read_text() in read.database_url
    assert read.admin_key != read.metrics_key
    assert subprocess.run(["sh", script], check=False, stderr=subprocess.DEVNULL).returncode == 1


@pytest.mark.skipif(shutil.which("caddy") is None, reason="no caddy: apt-get install caddy")
def test_caddy_understands_its_file(tmp_path: Path) -> None:
    command = ["caddy", "validate", "--adapter", "caddyfile", "--config", ROOT / "deploy" / "compose" / "Caddyfile"]
    subprocess.run(command, check=True, capture_output=True, env={"HOME": str(tmp_path)})


def test_the_dockerfile_has_nothing_to_mend() -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    run = subprocess.run([hadolint, "docker/Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.stdout == ""
    assert run.returncode == 0
    copied = set(re.findall(r"^COPY ([a-z].*) \S+$", DOCKERFILE, re.MULTILINE))
    allowed = set(re.findall(r"^!(.*)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))
    assert {name for line in copied for name in line.split()} == allowed
