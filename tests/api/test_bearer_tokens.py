"""Bearer tokens of an OpenID Connect issuer that is really there: good ones, forged ones, and it is away."""

import base64
import hashlib
import hmac
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.padding import PKCS1v15
from cryptography.hazmat.primitives.hashes import SHA256
from joserfc.jwk import ECKey, RSAKey
from sqlalchemy import select
from starlette.testclient import TestClient

from app.api import issuer_keys
from app.api.context import Context
from app.db.tables import Key, Organisation
from app.main import create_app, first_start
from app.services import key_ring
from app.settings import Settings
from app.viewer import sessions
from tests.api.issuer import AUDIENCE, Issuer, running

ADMIN = {"Authorization": "Bearer isd_admin"}


@dataclass(frozen=True)
class Guarded:
    """A service that takes the issuer's tokens."""

    http: TestClient
    context: Context
    issuer: Issuer

    def ask(self, token: str, path: str = "/v1/buildings") -> Any:
        return self.http.get(path, headers={"Authorization": f"Bearer {token}"})


@pytest.fixture(scope="module")
def issuer(database_url: str) -> Iterator[Issuer]:
    with running() as issuer:
        yield issuer


@pytest.fixture(scope="module")
def here(database_url: str, issuer: Issuer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("data"), database_url=database_url, admin_key="isd_admin",
        oidc_issuer=issuer.url, oidc_audience=AUDIENCE,
    )  # fmt: skip
    first_start(settings)
    app = create_app(settings)
    with TestClient(app, raise_server_exceptions=False) as http:
        yield Guarded(http, app.state.context, issuer)


@pytest.fixture(autouse=True)
def as_it_was(here: Guarded) -> Iterator[None]:
    here.issuer.answers = True
    yield
    here.issuer.answers = True


def asked_long_ago(here: Guarded) -> None:
    """As if the issuer had not been asked for a while."""
    assert here.context.tokens is not None
    here.context.tokens.keys._asked_at = time.monotonic() - issuer_keys.ASK_EVERY_S


@pytest.mark.parametrize("kid", ["rsa-1", "ec-1"])
def test_a_good_token_is_a_key(here: Guarded, kid: str) -> None:
    token = here.issuer.token(kid)
    assert here.ask(token).status_code == 200
    assert (
        here.http.post("/v1/buildings", json={"name": "x"}, headers={"Authorization": f"Bearer {token}"}).status_code
        == 403
    )
    wider = here.issuer.token(kid, aud=["another", AUDIENCE], scope=["map:write", "profile"])
    made = here.http.post("/v1/buildings", json={"name": "Lab"}, headers={"Authorization": f"Bearer {wider}"})
    assert made.status_code == 201
    limited = here.issuer.token(kid, isodyn_buildings=[made.json()["id"]])
    assert [each["name"] for each in here.ask(limited).json()["items"]] == ["Lab"]
    nothing = here.issuer.token(kid, isodyn_buildings="")
    assert here.ask(nothing).json()["items"] == []


def test_a_subject_has_one_row_which_can_be_revoked(here: Guarded) -> None:
    """It stands for the subject in the log, in limits, and as who made a track; tokens come and go."""
    scopes = "map:write survey:write"
    for _ in range(2):
        token = here.issuer.token(sub="berta", scope=scopes, jti=str(time.monotonic_ns()))
        answer = here.http.post("/v1/buildings", json={"name": "B"}, headers={"Authorization": f"Bearer {token}"})
        assert answer.status_code == 201
    with here.context.transaction() as session:
        (row_id, secret_hash) = session.execute(select(Key.id, Key.sha256).where(Key.subject == "berta")).one()
    log = here.http.get("/v1/audit", params={"actor": row_id}, headers=ADMIN).json()["items"]
    assert [row["action"] for row in log] == ["key.create", "building.create", "building.create"]
    assert {row["actor"] for row in log} == {"berta"}
    assert here.ask(secret_hash).status_code == 401
    assert here.http.post(f"/v1/keys/{row_id}:rotate", headers=ADMIN).status_code == 409
    assert here.http.delete(f"/v1/keys/{row_id}", headers=ADMIN).status_code == 204
    until = time.monotonic() + 20
    while here.ask(token).status_code != 401:
        assert time.monotonic() < until
        time.sleep(0.1)
    assert here.ask(here.issuer.token(sub="berta")).status_code == 401, "another token is no way around it"


def parts(header: dict[str, Any], claims: dict[str, Any], signature: bytes = b"") -> str:
    def coded(data: bytes) -> str:
        return base64.urlsafe_b64encode(data).rstrip(b"=").decode()

    return ".".join([coded(json.dumps(header).encode()), coded(json.dumps(claims).encode()), coded(signature)])


def with_public_key_as_secret(issuer: Issuer) -> str:
    """HS256 with the RSA public key, as PEM, for the secret."""
    head = parts({"alg": "HS256", "kid": "rsa-1"}, issuer.claims()).rpartition(".")[0]
    pem = issuer.keys["rsa-1"].as_pem(private=False)
    signed = hmac.new(pem, head.encode(), hashlib.sha256).digest()
    return f"{head}.{base64.urlsafe_b64encode(signed).rstrip(b'=').decode()}"


def signed(header: dict[str, Any], issuer: Issuer) -> str:
    """By the issuer's own key, whatever the header says."""
    head = parts(header, issuer.claims()).rpartition(".")[0]
    signature = issuer.keys["rsa-1"].private_key.sign(head.encode(), PKCS1v15(), SHA256())
    return f"{head}.{base64.urlsafe_b64encode(signature).rstrip(b'=').decode()}"


def forged(issuer: Issuer) -> dict[str, str]:
    now = int(time.time())
    good = issuer.token()
    head, body, signature = good.split(".")
    own = RSAKey.generate_key(2048, {"kid": "rsa-1"})
    admin = parts({}, issuer.claims(scope="admin")).split(".")[1]
    curve = ECKey.generate_key("P-256", {"kid": "ec-1"})
    jwk = own.as_dict(private=False)
    return {
        "alg none": parts({"alg": "none", "kid": "rsa-1"}, issuer.claims()),
        "alg None": parts({"alg": "None", "kid": "rsa-1"}, issuer.claims()),
        "no alg": parts({"kid": "rsa-1"}, issuer.claims()),
        "public key as secret": with_public_key_as_secret(issuer),
        "another's key": issuer.token(key=own),
        "another's key, in the header": issuer.token(key=own, header={"jwk": jwk}),
        "another's key, at an address": issuer.token(key=own, header={"jku": f"{issuer.url}/a"}),
        "another's certificate": issuer.token(key=own, header={"x5u": f"{issuer.url}/b"}),
        "another's curve": issuer.token("ec-1", key=curve),
        "the other kind of key": issuer.token("ec-1", header={"kid": "rsa-1"}),
        "changed claims": f"{head}.{admin}.{signature}",
        "no signature": f"{head}.{body}.",
        "wrong audience": issuer.token(aud="another"),
        "no audience": issuer.token(aud=None),
        "audience as part of a word": issuer.token(aud="isodyn-staging"),
        "wrong issuer": issuer.token(iss="https://elsewhere.example"),
        "no issuer": issuer.token(iss=None),
        "expired": issuer.token(exp=now - 60, iat=now - 600),
        "never ends": issuer.token(exp=None),
        "ends at no number": issuer.token(exp="tomorrow"),
        "ends off the calendar": issuer.token(exp=10**30),
        "not yet valid": issuer.token(nbf=now + 300),
        "from the future": issuer.token(iat=now + 300),
        "no subject": issuer.token(sub=None),
        "subject is no name": issuer.token(sub="a\nb"),
        "long subject": issuer.token(sub="a" * 256),
        "an organisation there is not": issuer.token(isodyn_organisation="nowhere"),
        "no organisation": issuer.token(isodyn_organisation=None),
        "organisation is no name": issuer.token(isodyn_organisation="default\x00"),
        "organisation is a list": issuer.token(isodyn_organisation=["default"]),
        "buildings are numbers": issuer.token(isodyn_buildings=[1, 2]),
        "another type": issuer.token(header={"typ": "logout+jwt"}),
        "critical header": signed({"alg": "RS256", "kid": "rsa-1", "crit": ["b64"], "b64": True}, issuer),
        "odd, and well signed": signed({"alg": "RS256", "kid": "rsa-1", "typ": 7}, issuer),
        "no kid": parts({"alg": "RS256"}, issuer.claims()),
        "kid is a path": issuer.token(header={"kid": "../../etc/passwd"}, key=own),
        "kid is a statement": issuer.token(header={"kid": "' OR 1=1 --"}, key=own),
        "kid is a list": parts({"alg": "RS256", "kid": ["rsa-1"]}, issuer.claims()),
        "kid is long": parts({"alg": "RS256", "kid": "k" * 4000}, issuer.claims()),
        "huge": issuer.token(padding="x" * 20_000),
        "deep": parts({"alg": "RS256", "kid": "rsa-1"}, {}).replace(".", "." + "W1tb" * 1500, 1),
        "deep header": "eyJh" + "W1tb" * 1500 + ".e30.x",
        "no json": "eyJhbGciOiJSUzI1NiIs.e30.x",
    }  # fmt: skip


def test_no_forged_token_opens_anything(here: Guarded) -> None:
    assert here.ask(here.issuer.token()).status_code == 200
    before = here.http.get("/v1/keys", headers=ADMIN).json()["items"]
    answers = set()
    for what, token in forged(here.issuer).items():
        answer = here.ask(token)
        assert answer.status_code == 401, f"{what}: {answer.status_code} {answer.text}"
        answers.add(str(answer.json() | {"request_id": None}))
    assert len(answers) == 1, "and none is told why"
    assert [path for path in here.issuer.fetched if path not in ("/keys", "/.well-known/openid-configuration")] == []
    assert here.http.get("/v1/keys", headers=ADMIN).json()["items"] == before
    with here.context.transaction() as session:
        assert session.scalars(select(Organisation.name)).all() == ["default"]


def test_keys_nobody_knows_make_few_fetches(here: Guarded) -> None:
    asked_long_ago(here)
    own = RSAKey.generate_key(2048)
    before = len(here.issuer.fetched)
    for number in range(30):
        assert here.ask(here.issuer.token(header={"kid": f"k{number}"}, key=own)).status_code == 401
    assert len(here.issuer.fetched) - before <= 2 * (1 + 1), "discovery and keys, each time; once in ten seconds"


def test_a_new_key_of_the_issuer_is_found(here: Guarded) -> None:
    here.issuer.keys["rsa-2"] = RSAKey.generate_key(2048, {"kid": "rsa-2"})
    asked_long_ago(here)
    assert here.ask(here.issuer.token("rsa-2")).status_code == 200


def test_while_the_issuer_is_away_known_keys_go_on(here: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(key_ring, "RECENT_S", 0.0)
    assert here.ask(here.issuer.token()).status_code == 200
    here.issuer.answers = False
    here.issuer.keys["rsa-3"] = RSAKey.generate_key(2048, {"kid": "rsa-3"})
    asked_long_ago(here)
    token = here.issuer.token("rsa-3")
    for _ in range(2):  # asked, and too early to ask again
        answer = here.ask(token)
        assert answer.status_code == 503, "nobody can tell: not refused for good, and never let in"
        assert 1 <= int(answer.headers["retry-after"]) <= issuer_keys.ASK_EVERY_S
    assert here.ask(here.issuer.token()).status_code == 200
    assert here.ask("isd_admin").status_code == 200, "keys know nothing of it"
    here.issuer.answers = True
    asked_long_ago(here)
    assert here.ask(token).status_code == 200


def test_an_issuer_that_calls_itself_another_is_not_believed(here: Guarded) -> None:
    here.issuer.keys["rsa-4"] = RSAKey.generate_key(2048, {"kid": "rsa-4"})
    here.issuer.told_issuer = "https://elsewhere.example"
    asked_long_ago(here)
    try:
        assert here.ask(here.issuer.token("rsa-4")).status_code == 503
    finally:
        here.issuer.told_issuer = here.issuer.url


def test_weak_and_shared_keys_of_an_issuer_are_not_used(here: Guarded) -> None:
    public = here.issuer.keys["ec-1"].as_dict(private=False)
    assert issuer_keys._usable(public) is not None
    shared = {"kty": "oct", "kid": "s", "k": "c2VjcmV0LXNlY3JldC1zZWNyZXQtc2VjcmV0"}
    modulus = base64.urlsafe_b64encode(b"\xff" * 64).decode().rstrip("=")
    weak = {"kty": "RSA", "kid": "w", "n": modulus, "e": "AQAB"}
    for unusable in (shared, weak, public | {"use": "enc"}, public | {"kid": 7}, {"kty": "EC", "kid": "b"}, None, []):
        assert issuer_keys._usable(unusable) is None


def test_the_page_takes_a_token_and_ends_with_it(here: Guarded, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "RECHECK_SECONDS", 0.1)
    origin = {"Origin": "http://testserver"}
    token = here.issuer.token(sub="carla", exp=int(time.time()) - 28)  # within the leeway of clocks, for 2 s more
    signed = here.http.post("/view/session", data={"key": token}, headers=origin, follow_redirects=False)
    assert signed.status_code == 303
    until = time.monotonic() + 30
    while here.http.get("/view/session", headers=origin).status_code != 401:
        assert time.monotonic() < until
        time.sleep(0.2)
    here.http.cookies.clear()


def test_both_settings_or_none(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="ISODYN_OIDC_AUDIENCE"):
        Settings(data_dir=tmp_path, oidc_issuer="https://id.example")
