"""Bearer tokens of an OpenID Connect issuer: JSON Web Tokens, taken beside API keys where settings name an issuer."""

import json
import logging
from base64 import urlsafe_b64decode
from datetime import UTC, datetime
from typing import Any, TypeGuard

from joserfc import jwt
from joserfc.errors import JoseError
from joserfc.jws import JWSRegistry

from app.api.issuer_keys import IssuerKeys, PublicKey
from app.services.key_ring import TokenClaims
from app.services.manage_keys import SCOPES
from app.settings import Settings

__all__ = ["BearerTokens"]

_log = logging.getLogger(__name__)

ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "Ed25519")
"""Signatures by key pairs. Never `none`, and never a shared secret: the issuer's public key would be one."""
TYPES = (None, "jwt", "at+jwt", "application/at+jwt")
MOST_BYTES = 8192
MOST_KID = 256
LEEWAY_S = 30
"""By which clocks may differ."""
LATEST = datetime(9000, 1, 1, tzinfo=UTC).timestamp()


class BearerTokens:
    """Reads tokens of the issuer that settings name. `keys` are the issuer's."""

    def __init__(self, settings: Settings) -> None:
        assert settings.oidc_issuer is not None
        assert settings.oidc_audience is not None
        self.keys = IssuerKeys(settings.oidc_issuer)
        self._settings = settings
        self._registry = _Registry(algorithms=ALGORITHMS, strict_check_header=False)
        self._claims = jwt.JWTClaimsRegistry(
            leeway=LEEWAY_S,
            iss={"essential": True, "value": settings.oidc_issuer},
            aud={"essential": True, "value": settings.oidc_audience},
            sub={"essential": True},
            exp={"essential": True},
        )

    def __call__(self, token: str) -> TokenClaims | None:
        """What a token says; None, and the reason in the log, when it is not good. Raises Unavailable."""
        try:
            return self._read(token)
        except (JoseError, ValueError, TypeError, OverflowError, RecursionError) as error:
            _log.info("a bearer token was refused: %s: %s", type(error).__name__, error)
            return None

    def _read(self, token: str) -> TokenClaims | None:
        if len(token) > MOST_BYTES:
            raise ValueError(f"it is longer than {MOST_BYTES} bytes")
        key = self._key(token)
        if key is None:
            raise ValueError("it names a key the issuer does not have")
        claims = jwt.decode(token, key, algorithms=ALGORITHMS, registry=self._registry).claims
        self._claims.validate(claims)
        subject, ends = claims["sub"], claims["exp"]
        if not _is_name(subject, 255):
            raise ValueError("its subject is no name of at most 255 characters")
        if not 0 < ends < LATEST:
            raise ValueError("it ends at no time of the calendar")
        organisation = claims.get(self._settings.oidc_organisation_claim, self._settings.oidc_organisation)
        if not _is_name(organisation, 200):
            raise ValueError(f"its claim {self._settings.oidc_organisation_claim} names no organisation")
        buildings = claims.get(self._settings.oidc_buildings_claim)
        return TokenClaims(
            issuer=claims["iss"],
            subject=subject,
            organisation=organisation,
            scopes=_words(claims.get(self._settings.oidc_scopes_claim, "")).intersection(SCOPES),
            building_ids=None if buildings is None else _words(buildings),
            expires_at=datetime.fromtimestamp(ends, UTC),
        )

    def _key(self, token: str) -> PublicKey | None:
        """The issuer's key that the header names, by its id alone: addresses and keys in a header are not looked at."""
        header = _header(token)
        kind, kid = header.get("typ"), header.get("kid")
        if (kind.lower() if isinstance(kind, str) else kind) not in TYPES:
            raise ValueError(f"it is of type {str(kind)[:40]!r}")
        if "crit" in header:
            raise ValueError("its header has what must be understood, and is not")
        if header.get("alg") not in ALGORITHMS:  # before the issuer is asked for anything
            raise ValueError(f"algorithm {str(header.get('alg'))[:20]!r} is not taken")
        if not isinstance(kid, str) or not 1 <= len(kid) <= MOST_KID:
            raise ValueError("its header names no key (kid)")
        return self.keys.find(kid)


class _Registry(JWSRegistry):
    """The library's, for headers with a chain of certificates, which are long and not looked at."""

    max_header_length = MOST_BYTES
    max_payload_length = MOST_BYTES


def _header(token: str) -> dict[str, Any]:
    part = token.partition(".")[0]
    header = json.loads(urlsafe_b64decode(part + "=" * (-len(part) % 4)))
    if not isinstance(header, dict):
        raise ValueError("its header is no JSON object")
    return header


def _is_name(told: object, longest: int) -> TypeGuard[str]:
    return isinstance(told, str) and 1 <= len(told) <= longest and told.isprintable()


def _words(told: object) -> frozenset[str]:
    """A claim of words: parted by spaces, or a list. Raises ValueError for anything else."""
    words = told.split() if isinstance(told, str) else told
    if not isinstance(words, list) or not all(isinstance(each, str) for each in words):
        raise ValueError("a claim is neither words nor a list of them")
    return frozenset(words)
