"""One typed tree of settings. ``services.cli`` alone reads environment (prefix ``DENTINE__``) and files into it."""

from __future__ import annotations

import ipaddress
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from pydantic import Field, SecretStr, ValidationError, model_validator

from services.core.errors import SettingsError
from services.core.files.fault_words import words_of
from services.core.files.validation import remedied
from services.core.geometry import Record
from services.core.light.safety import (
    FREE_FLASHES_PER_S,
    SHIPPED_LIGHT_LIMIT_S,
    SHIPPED_TOTAL_LIMIT_S,
    AssessmentOfLights,
    DoseOfAllLights,
    DoseOfOneLight,
    unassessed,
)
from services.core.records import MAX_ON_TIME_S, SIMULATED_DOME, JobSpec

DATABASE_FILE = "dentine.sqlite"
"""Name of the database in the data folder."""


class SettingsRecord(Record):
    """Base of settings, whose values are texts of an environment's variables."""

    numbers_from_text = True


class RateSettings(SettingsRecord):
    """How often one token, or one address without a token, may ask."""

    reads_per_10_s: int = Field(
        default=10_000, gt=0, description="requests that change nothing; an event stream counts once"
    )
    writes_per_10_s: int = Field(default=2_000, gt=0, description="requests that change something")
    refusals_per_minute: int = Field(
        default=60,
        gt=0,
        description="requests of one address without a valid token that are answered and audited one by one",
    )


class UploadLimits(SettingsRecord):
    """What captures may be uploaded. Sizes are checked when a capture is created, images when it is committed."""

    largest_file_bytes: int = Field(default=16 * 2**30, ge=1, description="largest file of a capture")
    largest_text_bytes: int = Field(
        default=64 * 2**20, ge=1, description="largest .json, .jsonl or .toml file, which is read whole"
    )
    largest_capture_bytes: int = Field(default=256 * 2**30, ge=1, description="largest capture")
    most_files: int = Field(default=5000, ge=1, le=100_000, description="most files in a capture")
    largest_image_bytes: int = Field(
        default=4 * 2**30, ge=1, description="largest image, as its header declares it decoded"
    )
    open_for_s: float = Field(
        default=7 * 86400.0, gt=0, description="an open capture expires this long after the last byte received"
    )
    silence_s: float = Field(
        default=30.0, gt=0, description="a request that sends nothing for this long is ended; what it sent is kept"
    )
    keep_free_bytes: int = Field(
        default=2**30, ge=0, description="free disk that open captures, fully received, must leave"
    )


class ConnectionLimits(SettingsRecord):
    """How many connections a server keeps, and how long each may wait for a request."""

    most: int = Field(
        default=2000,
        ge=8,
        description="connections at once; beyond them those without a request make room, longest waiting first",
    )
    header_s: float = Field(
        default=10.0, gt=0, description="a connection is closed if the head of a request is not whole by then"
    )
    streams_per_token: int = Field(default=500, gt=0, description="event streams that one token may hold open")
    streams_per_address: int = Field(default=1000, gt=0, description="event streams that one address may hold open")


class DomeSettings(SettingsRecord):
    """The dome that a server works by hand, and how far any of its jobs may go with a dome: a job may ask for less,
    never for more.
    """

    address: str | None = Field(
        default=None,
        description="host:port of the Modbus controller, or 'simulated' for one of the server's own; default is none",
    )
    job_addresses: str = Field(
        default="",
        description=(
            "host:port of further domes that jobs may capture with, separated by commas; the server's own and"
            " 'simulated' always may"
        ),
    )
    watchdog_s: float = Field(
        default=2.0, gt=0, le=60, description="the dome goes dark by itself when not fed for this long"
    )
    light_exposure_limit_s: DoseOfOneLight[float] = Field(default=SHIPPED_LIGHT_LIMIT_S, gt=0)
    total_exposure_limit_s: DoseOfAllLights[float] = Field(default=SHIPPED_TOTAL_LIMIT_S, gt=0)
    assessment: AssessmentOfLights = None
    max_flashes_per_s: float = Field(
        default=10.0,
        ge=FREE_FLASHES_PER_S,
        le=100,
        description="most flashes a second that a job or preflight with an acknowledgement may ask for; 3 for no more",
    )
    max_level: float = Field(default=1.0, gt=0, le=1, description="highest LED level, fraction of full scale")
    max_exposure_s: float = Field(
        default=10.0,
        gt=0,
        le=MAX_ON_TIME_S,
        description="longest exposure, settling included: one light at full level then takes the whole default limit",
    )

    @model_validator(mode="after")
    def _assessed(self) -> DomeSettings:
        limits = self.light_exposure_limit_s, self.total_exposure_limit_s
        if lacking := unassessed(*limits, self.assessment):
            raise ValueError(lacking)
        return self

    @property
    def allowed_addresses(self) -> frozenset[str]:
        """Addresses of the domes with which jobs may capture."""
        further = (one.strip() for one in self.job_addresses.split(","))
        return frozenset(one for one in (SIMULATED_DOME, self.address, *further) if one)


class ServerSettings(SettingsRecord):
    """The API server."""

    host: str = Field(default="127.0.0.1", description="address to listen on")
    port: int = Field(default=8000, ge=0, le=65535, description="0 picks a free port")
    data: Path = Field(default=Path("dentine-data"), description="folder of the jobs and, by default, the database")
    database: SecretStr | None = Field(
        default=None, description="postgresql://USER@HOST/NAME; default is SQLite in the data folder"
    )
    database_password_file: Path | None = Field(
        default=None, description="file with the password of the database; read for every connection"
    )
    scheduler: str | None = Field(
        default=None, description="address of a Dask scheduler whose workers see the data folder; default: own workers"
    )
    tls: Path | None = Field(
        default=None,
        description="folder with ca.crt, tls.crt and tls.key: API, scheduler and workers speak TLS; default: without",
    )
    jobs_at_once: int = Field(
        default=4,
        ge=1,
        le=64,
        description="most jobs that run side by side; captures of further ones begin nevertheless",
    )
    keep_days: float | None = Field(
        default=None, gt=0, description="days after which a job that has ended is deleted; default is never"
    )
    private_webhooks: bool = Field(
        default=False, description="whether webhooks may go to private and loopback addresses, and there without TLS"
    )
    access: Literal["tokens", "open"] = Field(
        default="open", description="tokens: every caller needs one; open: none is asked for, on loopback only"
    )
    public_url: str | None = Field(
        default=None,
        pattern=r"^https?://[^\s#?]+$",
        description="address of the page as people reach it, such as https://teeth.example.org",
    )
    job_roots: str = Field(
        default="",
        description=(
            "absolute folders on the server below which jobs may name captures, mouths and calibrations, separated by"
            " commas; default: none where callers need tokens, any on an open server"
        ),
    )
    stores: str = Field(
        default="",
        description="s3://BUCKET/PREFIX below which jobs may keep what they prepare, separated by commas; "
        "default: none",
    )
    names: str = Field(
        default="", description="further host names that clients use for this server, separated by commas"
    )
    trusted_proxies: str = Field(
        default="", description="addresses of proxies whose X-Forwarded-For is believed, separated by commas"
    )
    session_s: float = Field(default=8 * 3600.0, gt=0, description="how long a browser stays signed in, s")
    body_limit_bytes: int = Field(default=2**20, gt=0, description="longest body that is read, uploads excepted")
    rates: RateSettings = RateSettings()
    connections: ConnectionLimits = ConnectionLimits()
    dome: DomeSettings = DomeSettings()
    uploads: UploadLimits = UploadLimits()

    @property
    def database_url(self) -> str:
        """URL of the database, with its password or the file that holds it."""
        if self.database is None:
            return f"sqlite:///{self.data.resolve() / DATABASE_FILE}"
        url = self.database.get_secret_value()
        if self.database_password_file is None:
            return url
        return f"{url}{'&' if '?' in url else '?'}password_file={quote(str(self.database_password_file))}"

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches the server."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


class ClientSettings(SettingsRecord):
    """The command line as a client of a server."""

    token: SecretStr | None = Field(default=None, description="what `dentine token create` printed")


class Settings(SettingsRecord):
    """Everything a deployment may set."""

    server: ServerSettings = ServerSettings()
    client: ClientSettings = ClientSettings()


def read_settings(environment: Mapping[str, str], prefix: str = "DENTINE__") -> Settings:
    """Build settings from variables such as ``DENTINE__SERVER__PORT``.

    Raises:
        SettingsError: a key is unknown or a value has a wrong type; the message names the variable.
    """
    tree: dict[str, Any] = {}
    for variable, value in environment.items():
        if variable.startswith(prefix):
            *path, leaf = variable.removeprefix(prefix).lower().split("__")
            node = tree
            for part in path:
                node = node.setdefault(part, {})
                if not isinstance(node, dict):
                    raise SettingsError(
                        f"Setting {variable} needs a group of which another variable sets the whole; remove one of the"
                        " two."
                    )
            if isinstance(node.get(leaf), dict):
                raise SettingsError(
                    f"Setting {variable} is a group, of which other variables set single values; remove it."
                )
            node[leaf] = value
    try:
        return Settings.model_validate(tree)
    except ValidationError as problem:
        first = problem.errors()[0]
        name = prefix + "__".join(str(part).upper() for part in first["loc"])
        words = words_of(first)
        remedy = "" if "; " in words else "; correct or remove the variable"
        raise SettingsError(f"Setting {name}: {words}{remedy}.") from problem


def read_job(path: Path) -> JobSpec:
    """Read JOB.toml. Relative paths in it are relative to the file.

    Raises:
        SettingsError: the file is no TOML, or an option is unknown or has a wrong value; the message names the option.
    """
    if not path.is_file():
        raise SettingsError(f"Job file {path} does not exist; check the path.")
    try:
        tree = tomllib.loads(path.read_text())
    except RecursionError as problem:
        raise SettingsError(
            f"Job file {path} nests brackets too deeply; a job's options need three levels at most."
        ) from problem
    except (ValueError, OSError) as problem:  # also raised by numbers beyond all limits, and by bytes that are no UTF-8
        raise SettingsError(f"Job file {path} is not valid TOML: {problem}; correct that line.") from problem
    return job_from_tree(tree, path.parent, str(path))


def job_from_tree(tree: Mapping[str, Any], base: Path, origin: str) -> JobSpec:
    """Validate a job's options; relative paths are resolved against ``base``.

    Raises:
        SettingsError: an option is unknown or has a wrong value; the message names it and what is wrong.
    """
    try:
        spec = JobSpec.model_validate(dict(tree))
    except ValidationError as problem:
        first = problem.errors()[0]
        option = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = ", ".join(sorted(JobSpec.model_fields))
            raise SettingsError(f"{origin}: unknown option '{option}'; known options are {known}.") from problem
        what = f"option '{option}': " if option else ""
        raise SettingsError(f"{origin}: {what}{remedied(first)}.") from problem
    for option, path in {
        "capture": spec.capture,
        "calibration": spec.calibration,
        "rig.mouth": spec.rig and spec.rig.mouth,
    }.items():
        if path is not None and "\0" in str(path):
            raise SettingsError(f"{origin}: option '{option}' holds the character NUL, which no path has; correct it.")
    if spec.channels == ():
        raise SettingsError(f"{origin}: option 'channels' is empty; name a channel, or leave it out to fit all.")
    if spec.capture is not None:
        spec = spec.model_copy(update={"capture": (base / spec.capture).resolve()})
    if spec.calibration is not None:
        spec = spec.model_copy(update={"calibration": (base / spec.calibration).resolve()})
    if spec.rig is not None and not spec.is_demo:
        spec = spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": (base / spec.rig.mouth).resolve()})})
    return spec
