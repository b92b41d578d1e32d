"""Model of all settings. Each is an environment variable: `GRASPD_` and the field's name in capitals."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

if TYPE_CHECKING:
    from sqlalchemy import URL


GONE: Final = {
    "GRASPD_SHARD_PACK": "a task makes one shard of all its batches; unset it, and see GRASPD_TASK_S",
    "GRASPD_KEEPER_SHARDS": "one controller leads and the others stand by; unset it",
    "GRASPD_KEEPER_INTERVAL_S": "use GRASPD_CONTROLLER_INTERVAL_S",
    "GRASPD_FIRST_JUDGE": "use GRASPD_PREFILTER",
    "GRASPD_KEEPER_NAME": "use GRASPD_CONTROLLER_NAME",
    "GRASPD_SCRUB_MB_PER_S": "use GRASPD_INTEGRITY_SCAN_MB_PER_S",
}


class Settings(BaseSettings):
    """Settings of all processes of one graspd. Defaults run everything on one machine inside `data_dir`."""

    # Compose and Kubernetes set unset variables to an empty text.
    model_config = SettingsConfigDict(
        env_prefix="GRASPD_", env_ignore_empty=True, frozen=True, hide_input_in_errors=True
    )

    data_dir: Path = Field(Path("graspd-data"), description="folder of all local data of graspd")
    redis_url: SecretStr | None = Field(None, description="Redis of the queue; unset: `graspd up` starts one")
    store_url: str | None = Field(None, description="object store: file://, s3://, gs://, az://; unset: in data_dir")
    store_public_endpoint: str | None = Field(
        None, description="public S3 endpoint for direct downloads; unset: downloads go through the API"
    )
    index_url: SecretStr | None = Field(None, description="SQLAlchemy URL of the index; unset: SQLite in data_dir")
    host: str = Field("127.0.0.1", description="address to which the API binds")
    port: int = Field(8000, ge=0, le=65535, description="port to which the API binds; 0: any free port")
    docs_url: str | None = Field(
        None, pattern="^https?://", description="address of the documentation, linked in the footer of the dashboard"
    )
    api_root_path: str | None = Field(
        None, description="path under which a proxy serves the API and the dashboard, such as /graspd; unset: the root"
    )
    api_url: str = Field(
        "http://127.0.0.1:8000", description="address of the API for client commands; unset: the service of data_dir"
    )
    api_key: SecretStr | None = Field(None, description="API key of the client commands")
    keys_file: Path | None = Field(None, description="file of the API keys; unset: keys.json in data_dir")
    proxy_addresses: str | None = Field(
        None, description="addresses or networks of an authenticating proxy, separated by commas; unset: none"
    )
    proxy_secret: SecretStr | None = Field(None, description="secret that the proxy sends; at least 16 characters")
    proxy_groups: dict[str, str] = Field(
        {}, description='rights of proxy groups; the first match counts: {"lab": "vision:submit", "*": ":read"}'
    )
    metrics_need_key: bool = Field(True, description="whether /metrics requires a key once keys exist")
    requests_per_minute: int = Field(1200, ge=0, description="maximum requests per minute of one API key; 0: no limit")
    address_requests_per_minute: int = Field(
        120, ge=0, description="maximum requests per minute from one IP address without an API key; 0: no limit"
    )
    concurrency: int = Field(64, ge=0, description="maximum concurrent requests of one key or IP address; 0: no limit")
    quota_grasps_in_flight: int = Field(
        0, ge=0, description="maximum number of grasps in unfinished jobs of one API key; 0: no limit"
    )
    quota_jobs_per_day: int = Field(0, ge=0, description="maximum new jobs of one API key per UTC day; 0: no limit")
    webhook_secret: SecretStr | None = Field(
        None, min_length=16, description="secret from which the secrets of webhooks are derived; unset: no webhooks"
    )
    webhook_networks: str | None = Field(
        None, description="networks that webhooks may reach besides public addresses, separated by commas"
    )
    device: str = Field("auto", description="Warp device of a worker: cpu, cuda:0, or auto")
    worker_number: int | None = Field(
        None, ge=0, description="number of a worker on its machine: with device auto, worker k uses the k-th GPU"
    )
    prefilter: Literal["auto", "on", "off"] = Field(
        "auto", description="whether MuJoCo Warp decides clear cases of validation; auto: on a GPU, if installed"
    )
    threads: int = Field(0, ge=0, description="CPU threads of a worker; 0: one per core")
    processes: int = Field(
        0, ge=0, le=1024, description="processes for validation and metrics; 0: all cores but one with a GPU, else 1"
    )
    workers_here: int = Field(1, ge=1, description="workers on this machine that share its cores and memory")
    join: str = Field(
        "auto",
        pattern=r"^(auto|[1-9][0-9]{0,3})$",
        description="number of a task's batches per kernel launch; auto: as many as fill the GPU, 1 on a CPU",
    )
    lease_s: float = Field(6.0, gt=0.5, description="time without a heartbeat after which a worker loses its task [s]")
    controller_interval_s: float = Field(1.0, gt=0, description="pause between two rounds of the controller [s]")
    controller_name: str | None = Field(
        None, max_length=200, description="name of a controller, which leads at once after a restart; unset: a new name"
    )
    task_attempts: int = Field(3, ge=1, le=20, description="attempts of a task before its job fails")
    task_s: float = Field(60.0, ge=0, description="target duration of a task [s]; 0: one batch")
    task_timeout_s: float = Field(1800.0, gt=0, description="maximum run time of one task [s]")
    worker_max_memory_mb: int = Field(
        0, ge=0, description="resident memory at which a worker is replaced [MiB]; 0: half of all memory"
    )
    retry_backoff_s: float = Field(2.0, ge=0, description="delay of the second attempt [s], doubled before later ones")
    max_upload_bytes: int = Field(64 * 2**20, gt=0, description="largest HTTP upload of an asset [bytes]")
    queue_window: int = Field(
        1000, ge=1, description="maximum queued tasks per priority, at least two per worker; others wait in the index"
    )
    shard_grace_s: float = Field(
        7 * 86400.0, ge=0, description="time during which deletions can be restored and unused shards are kept [s]"
    )
    integrity_scan_mb_per_s: float = Field(
        1.0, ge=0, description="rate at which the controller's integrity scan reads the store [MiB/s]; 0: off"
    )
    cpu_price_per_h: float = Field(0.0, ge=0, description="price of an hour of a CPU worker; 0: no prices on pages")
    gpu_price_per_h: float = Field(0.0, ge=0, description="price of an hour of a GPU worker; 0: no prices on pages")
    price_unit: str = Field("USD", max_length=8, description="currency of the prices")
    stop_grace_s: float = Field(10.0, gt=0, description="time for a process to stop before it is killed [s]")
    kernels: Path | None = Field(
        None, description="folder of `graspd admin kernels`: compiled kernels, copied to Warp's cache if missing there"
    )
    heartbeat_file: Path | None = Field(
        None, description="file that a running controller or worker touches, for health checks; unset: none"
    )
    log_level: str = Field("INFO", description="DEBUG, INFO, WARNING or ERROR")
    log_format: Literal["auto", "json", "text"] = Field(
        "auto", description="format of log lines; auto: text on a terminal, else json"
    )

    @field_validator("api_root_path")
    @classmethod
    def _normalize_root_path(cls, value: str | None) -> str | None:
        if value is None:
            return None
        found = f"/{value.strip('/')}".rstrip("/")
        if not re.fullmatch(r"(/[A-Za-z0-9._~-]+)*", found) or {".", ".."} & set(found.split("/")):
            raise ValueError("write a path such as /graspd, of letters, digits, dots, dashes and underscores")
        return found or None

    @cached_property
    def resolved_store_url(self) -> str:
        return self.store_url or (self.data_dir.resolve() / "store").as_uri()

    @cached_property
    def resolved_keys_file(self) -> Path:
        return self.keys_file or self.data_dir.resolve() / "keys.json"

    @cached_property
    def resolved_index_url(self) -> str | URL:
        if self.index_url is not None:
            return self.index_url.get_secret_value()
        return sqlite_url(self.data_dir.resolve() / "index.sqlite")


def sqlite_url(path: Path) -> URL:
    """Return SQLAlchemy's URL of a file with any path; a text URL's path would end at a question mark."""
    from sqlalchemy import URL  # Only API and controller need this slow import.

    return URL.create("sqlite", database=str(path))
