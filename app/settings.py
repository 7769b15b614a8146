"""Settings, read once at the edge from `ISODYN_*` and passed on as values."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

__all__ = ["Settings"]


SECRETS_DIR = Path("/run/secrets")
"""Where containers find their secrets: what no variable tells may lie here, in a file of its name."""


class Settings(BaseSettings):
    """Every environment variable Isodyn reads."""

    model_config = SettingsConfigDict(
        env_prefix="ISODYN_", extra="ignore", secrets_dir=SECRETS_DIR if SECRETS_DIR.is_dir() else None
    )

    data_dir: Path = Field(default=Path("./var"), description="folder of the database and the blobs")
    database_url: str | None = Field(
        default=None, description="default: SQLite in the data folder; or postgresql+psycopg://"
    )
    blob_url: str | None = Field(
        default=None, description="default: a folder in the data folder; or s3://BUCKET/PREFIX"
    )
    admin_key: str | None = Field(
        default=None, description="the admin key; else one is made at first start and printed once"
    )
    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8300, ge=1, le=65535, description="port to listen on")
    max_upload_bytes: int = Field(default=64 * 2**20, description="largest survey body, before and after decompression")
    max_body_bytes: int = Field(default=4 * 2**20, description="largest JSON body")
    body_memory_bytes: int = Field(
        default=512 * 2**20,
        ge=2**20,
        description="memory for all bodies received at one time, a quarter of it for JSON",
    )
    max_requests: int = Field(default=500, ge=1, description="most requests open at one time, of all keys together")
    max_requests_per_key: int = Field(default=200, ge=1, description="most requests of one key open at one time")
    max_requests_per_s: float = Field(
        default=1000.0, gt=0, description="most requests of one key a second, sustained; ten seconds' worth at once"
    )
    max_streams_per_key: int = Field(
        default=200, ge=1, description="most WebSocket streams of one key open at one time"
    )
    max_buildings: int = Field(default=1000, ge=1, description="most buildings of one organisation")
    max_floors_per_building: int = Field(default=300, ge=1, description="most floors of one building")
    max_surveys: int = Field(default=200_000, ge=1, description="most surveys of one organisation")
    max_surveys_per_floor: int = Field(default=10_000, ge=1, description="most surveys of one floor")
    max_survey_bytes: int = Field(default=2**40, ge=1, description="most bytes of survey files of one organisation")
    max_keys: int = Field(default=10_000, ge=1, description="most keys of one organisation that have not ended")
    max_wait_s: float = Field(
        default=2.0, gt=0, description="longest wait for a search, a track's batch, or room for a body; else 503"
    )
    max_upload_wait_s: float = Field(
        default=60.0, gt=0, description="longest wait of a received file to be read; else 503"
    )
    max_window_samples: int = Field(default=2000, ge=1, le=20_000, description="most samples in one window")
    cors_origins: str = Field(
        default="",
        description="origins whose pages may call the API in a browser, separated by commas; none by default",
    )
    hsts_s: int = Field(
        default=0, ge=0, description="seconds for which browsers that came by TLS are told to do so again; 0: not told"
    )
    shutdown_s: float = Field(
        default=20.0, gt=0, le=600, description="time for what is being answered when the server is told to stop"
    )
    grid_cache_bytes: int = Field(default=512 * 2**20, description="memory for maps held ready to answer")
    track_idle_timeout_s: float = Field(
        default=600.0, gt=0, le=86_400, description="a track ends when no step came for this long"
    )
    max_tracks_per_key: int = Field(default=200, ge=1, description="most active tracks of one key")
    max_track_steps_per_s: float = Field(
        default=200.0, gt=0, description="most steps of one track a second, sustained; a minute of them at once"
    )
    track_cache_bytes: int = Field(default=512 * 2**20, description="memory for the states of tracks in use")
    oidc_issuer: str | None = Field(
        default=None, max_length=300, description="an OpenID Connect issuer whose bearer tokens are taken beside keys"
    )
    oidc_audience: str | None = Field(default=None, description="what such a token must name as its audience")
    oidc_organisation_claim: str = Field(default="isodyn_organisation", description="claim that names the organisation")
    oidc_organisation: str | None = Field(
        default=None, description="organisation of tokens without that claim; default: they are refused"
    )
    oidc_scopes_claim: str = Field(default="scope", description="claim with the scopes: words, or a list")
    oidc_buildings_claim: str = Field(
        default="isodyn_buildings", description="claim with the buildings a token is limited to: words, or a list"
    )
    audit_days: int = Field(default=400, ge=1, description="days that rows of the audit log are kept")
    parse_processes: int = Field(default=2, ge=1, le=64, description="foreign files read at one time, a process each")
    parse_memory_bytes: int = Field(default=2 * 2**30, ge=2**28, description="memory for reading one foreign file")
    parse_seconds: float = Field(default=120.0, gt=0, le=3600, description="time for reading one foreign file")
    worker_processes: int = Field(default=1, ge=1, description="child processes fitting maps at one time, per worker")
    trusted_proxies: str = Field(
        default="127.0.0.1,::1",
        description="addresses and networks, with commas, of proxies whose X-Forwarded-For and -Proto are believed",
    )
    log_format: Literal["text", "json"] = Field(default="text", description="a line for people, or JSON for machines")
    log_level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="the least of lines")
    metrics_key: str | None = Field(default=None, description="a key that may read /metrics and nothing else")
    worker_metrics_port: int | None = Field(
        default=None, ge=1, le=65535, description="port where a worker shows its metrics, on ISODYN_HOST, to anybody"
    )
    otel: bool = Field(default=False, description="send traces by OpenTelemetry; needs the extra `otel`")

    job_history_days: float = Field(
        default=7.0, ge=0, description="days that the job engine's own records of ended jobs stay"
    )
    track_history_days: float | None = Field(
        default=None, ge=0, description="days that ended tracks stay; default: for ever"
    )

    @model_validator(mode="after")
    def _oidc_is_whole(self) -> Self:
        if (self.oidc_issuer is None) != (self.oidc_audience is None):
            raise ValueError("ISODYN_OIDC_ISSUER and ISODYN_OIDC_AUDIENCE go together: set both or neither")
        return self

    @property
    def resolved_database_url(self) -> str:
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'isodyn.db'}"

    @property
    def resolved_blob_url(self) -> str:
        return self.blob_url or f"file://{self.data_dir.resolve() / 'blobs'}"
