"""Settings of the server, by priority: flags, ``FORECAST_*`` variables, a TOML file, defaults."""

import ipaddress
import os
import re
from collections.abc import Collection, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from service.environment import CONFIG, PREFIX, no_such_setting, unknown_variable
from service.redis_url import parse_address

_ORIGIN = re.compile(r"https?://[^/\s]+|\*")
FALLBACK_MODEL = "constant-velocity-yaw"
"""Model that forecasts the agents that the requested model cannot forecast."""


class SettingsError(Exception):
    """Error of invalid settings; the text names the setting and says why."""


class Engine(StrEnum):
    """Engines of the forward."""

    ONNXRUNTIME = "onnxruntime"
    EAGER = "eager"


class Settings(BaseSettings):
    """Settings for operators. Each is also an environment variable: ``http`` is ``FORECAST_HTTP``."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, protected_namespaces=())

    http: str = "127.0.0.1:8080"
    """HOST:PORT of REST; port 0: any free port."""
    grpc: str = "127.0.0.1:50051"
    """HOST:PORT of gRPC; port 0: any free port."""
    store: str = Field(default="memory", repr=False)
    """Track memory: "memory" (this process) or the URL of a Redis 7 (see ``service.redis_url``): redis:// or
    rediss:// for one server, redis+sentinel:// or redis+cluster://."""
    store_budget_ms: float = Field(default=20.0, gt=0)
    """Max time in ms that a call waits for the track memory; then the forecast is sent without tracking."""
    store_timeout_ms: float = Field(default=500.0, gt=0)
    """Timeout in ms of a Redis command."""
    store_connections: int = Field(default=16, ge=1)
    """Max number of connections to each Redis server for calls; streams of events have their own."""
    track_expiry: float = Field(default=30.0, ge=10.0)
    """Seconds without a call after which a scene is forgotten."""
    max_tracked_agents: int = Field(default=5_000, ge=1)
    """Max number of agents that this process keeps in memory; beyond it the scenes that were called longest
    ago are evicted. With Redis they are read again at their next call."""
    max_kept_raster_bytes: int = Field(default=256 * 2**20, ge=0)
    """Max size of the decoded scene rasters, three bytes a pixel, that this process keeps for calls that name
    them by their digest; beyond it the least recently used are dropped. 0: none is kept."""
    max_stored_raster_bytes: int = Field(default=64 * 2**20, ge=0)
    """Max size of the encoded scene rasters that all servers together keep in Redis, beside the tracks.
    0: none is kept there."""
    models: Path | None = None
    """Folder of checkpoints; None: the bundled ones, if any."""
    default_model: str | None = None
    """Model of requests that name none; None: "cab" if loaded, else "kalman"."""
    default_models: Annotated[dict[str, str], NoDecode] = Field(default_factory=dict)
    """Default models of some callers by the name of their API key, ``key-name=model,…`` in the environment;
    all others have ``default_model``."""
    shadow: str | None = None
    """``name@version:share``: a second model that forecasts a share of the scenes (0 to 1), and of the calls
    without a scene, once they are answered and while the model is free. Its consistency, errors and counts
    are in the metrics under ``name@version``; responses hold nothing of it."""
    reload_seconds: float | None = Field(default=None, ge=0.1)
    """Seconds between looks at the folder of models, of which every change is loaded; None: it is read again
    only on SIGHUP and by ReloadModels."""
    allow_paper_protocol: bool = False
    """Flag for loading models trained by the paper protocol, which warn in every response. Otherwise they are
    skipped, and a folder without other models is refused."""

    keys_file: Path | None = None
    """File of API keys, see ``cab-forecast keys``; a change takes effect within seconds. None: no keys."""
    api_tokens: Annotated[tuple[SecretStr, ...], NoDecode] = ()
    """Further accepted keys, without names and limits, and with all scopes; comma-separated in the
    environment."""
    allow_anyone: bool = False
    """Flag for listening on addresses that other machines can reach although neither ``keys_file`` nor
    ``api_tokens`` is set. Without keys every caller is accepted."""
    tls_certificate: Path | None = None
    """PEM file of the server's certificate and those between it and its authority, for both ports; a change
    takes effect within seconds. None: no TLS."""
    tls_key: Path | None = None
    """PEM file of the certificate's private key, without a password."""
    tls_client_ca: Path | None = None
    """PEM file of the authorities whose certificates clients must present on both ports; None: clients need
    no certificate."""
    probes: str | None = None
    """HOST:PORT of a further port without TLS for /livez and /readyz alone, for probes that cannot present a
    certificate; port 0: any free port; None: no such port."""
    cors_origins: Annotated[tuple[str, ...], NoDecode] = ()
    """Origins whose web pages may call REST, for example ``https://tools.example.com``; comma-separated in
    the environment; not set: no pages of other origins may."""

    console: bool | None = None
    """Flag for the live console at / of REST; where there are keys it asks for one with the scope ``read``.
    Not set: on, unless other machines can reach the server and it has no keys."""

    max_agents: int = Field(default=512, ge=1)
    """Max number of agents of a request."""
    max_states: int = Field(default=512, ge=1)
    """Max number of observations of an agent."""
    max_raster_pixels: int = Field(default=4096 * 4096, ge=1)
    """Max rows × columns of a scene raster."""
    max_request_bytes: int = Field(default=16 * 2**20, ge=1024)
    """Max size of an encoded request."""
    max_samples: int = Field(default=2000, ge=1)
    """Max number of samples of an agent."""
    max_samples_per_call: int = Field(default=100_000, ge=1)
    """Max number of samples of all agents of a request."""
    max_response_bytes: int = Field(default=32 * 2**20, ge=1024)
    """Max size of the samples of a response, as protobuf; they take up to three times as much as JSON."""

    max_explained_agents: int = Field(default=16, ge=1)
    """Max number of agents that one call of Explain explains; more may be neighbours."""
    max_explanation_forecasts: int = Field(default=8192, ge=1)
    """Max number of forecasts that are made for one call of Explain."""

    max_batch_agents: int = Field(default=256, ge=1)
    """Max number of agents in one forward."""
    max_queue_agents: int = Field(default=2048, ge=1)
    """Max number of agents accepted but not yet in the model; beyond it calls are refused as overload."""
    max_timeout: float = Field(default=30.0, gt=0)
    """Max duration of a call in seconds, whatever its own deadline. A forward that takes longer makes the
    server not ready."""
    max_concurrent_calls: int = Field(default=1024, ge=1)
    """Max number of calls in progress on both transports, from before their body is read until their response
    has been sent; beyond it calls are refused as overload. Streams of events (``max_watchers``), health
    checks, probes and metrics do not count. REST keeps at most twice as many connections, and closes those
    without a request first."""
    max_watchers: int = Field(default=64, ge=1)
    """Max number of streams of events on both transports; with Redis each holds a connection to it."""
    max_frame_bytes: int = Field(default=64 * 2**20, ge=0)
    """Max size of the frames that wait for slow watchers of scenes, of both transports; beyond it they lose
    their oldest ones."""
    max_intake_bytes: int = Field(default=256 * 2**20, ge=2048)
    """Max size of the bodies of all calls in progress, of both transports; bodies above 1 MiB may take three
    quarters of it. REST counts a body when its length is known, or as it arrives; gRPC when it has arrived,
    or as one of the largest size after a second."""
    header_timeout: float = Field(default=10.0, gt=0)
    """Seconds in which the headers of a REST request, or the handshake of a gRPC connection, must arrive."""
    body_timeout: float = Field(default=10.0, gt=0)
    """Seconds in which the body of a request must arrive."""
    write_timeout: float = Field(default=10.0, gt=0)
    """Seconds in which a client must go on reading its response. Then REST closes the connection, and a gRPC
    call stops to count as one in progress."""
    idle_timeout: float = Field(default=75.0, gt=0)
    """Seconds for which REST keeps a connection without a request. It should be longer than clients and
    proxies keep theirs, 60 s for many, or they send requests on connections that are about to be closed."""
    max_connection_age: float | None = Field(default=300.0, gt=0)
    """Seconds after which a client is told to open a new connection, so that load balancers can give a new
    server its share: over gRPC within 10 % of it, over REST with a later response. Calls and streams in
    progress go on to their end. None: connections may stay open for good."""
    drain_seconds: float = Field(default=10.0, ge=0)
    """Seconds that accepted calls get to finish when the server stops."""
    threads: int | None = Field(default=None, ge=1, le=1024)
    """Number of threads of all forwards together; None: the physical cores, at most the cores of the CPU
    quota."""
    workers: int | None = Field(default=None, ge=0, le=256)
    """Number of processes that run forwards, each with an interpreter of its own and its share of the
    threads; 0: threads of the server's process run them, two at a time. None: two to four, so that no thread
    is left over; with a single thread 0."""
    engine: Engine = Engine.ONNXRUNTIME
    """Engine of the forward: ``onnxruntime`` runs networks of the agent's frame as one native call and all
    other models in PyTorch; ``eager`` runs all models in PyTorch."""

    record: Path | None = None
    """Folder to which calls and their answers are recorded, for `cab-forecast replay` and Foxglove; not set:
    nothing is recorded. It needs the extra `record`, and each replica a folder of its own. Recordings hold
    where road users were: see docs/recording.md."""
    record_share: float = Field(default=1.0, gt=0, le=1)
    """Share of the answered calls that are recorded, drawn at random."""
    record_file_bytes: int = Field(default=128 * 2**20, ge=2**20)
    """Max size of a file of the recording."""
    record_files: int = Field(default=16, ge=2)
    """Max number of files in the folder of the recording; the oldest ones are deleted."""

    tracing: bool = False
    """Flag for traces by OpenTelemetry, sent by OTLP over gRPC as the standard ``OTEL_…`` variables say; they
    need the extra ``tracing``."""
    revision: str = ""
    """Revision of the source that this server was built from, for GetVersion and ``forecast_build_info``."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe level that is logged."""
    log_json: bool = False
    """Logs as JSON lines."""
    access_log: float = Field(default=0.0, ge=0, le=1)
    """Share of the calls, 0 to 1, that have a line in the log at ``info``; at ``debug`` all have one. The
    request id decides which, so that all servers log the same ones."""

    @field_validator("http", "grpc", "probes")
    @classmethod
    def _is_address(cls, value: str | None) -> str | None:
        if value is not None:
            split_address(value)
        return value

    @field_validator("keys_file", "tls_certificate", "tls_key", "tls_client_ca", mode="before")
    @classmethod
    def _names_a_file(cls, value: object) -> object:
        if value == "":
            raise ValueError("is set but names no file; leave it out if there is none")
        return value

    @field_validator("store")
    @classmethod
    def _is_known_store(cls, value: str) -> str:
        if value != "memory":
            parse_address(value)
        return value

    @field_validator("api_tokens", mode="before")
    @classmethod
    def _split_tokens(cls, value: object) -> object:
        if isinstance(value, str):
            # A trailing comma is no token. Commas alone name no token, for example an empty secret: without
            # the error below every caller would be accepted where only a few were meant to be.
            tokens = tuple(token.strip() for token in value.split(",") if token.strip())
            if not tokens:
                raise ValueError("is set but names no token; leave it out to accept every caller")
            return tokens
        if isinstance(value, Sequence):
            return tuple(_strip_token(token) for token in value)
        return value

    @field_validator("shadow")
    @classmethod
    def _is_shadow(cls, value: str | None) -> str | None:
        if value is not None:
            split_shadow(value)
        return value

    @field_validator("default_models", mode="before")
    @classmethod
    def _split_default_models(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        pairs = {}
        for pair in filter(None, map(str.strip, value.split(","))):
            key, equals, model = (part.strip() for part in pair.partition("="))
            if not (key and equals and model):
                raise ValueError(f'"{pair}" is not key-name=model')
            pairs[key] = model
        return pairs

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _split_origins(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(origin.strip() for origin in value.split(",") if origin.strip())
        return value

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for origin in value:
            if _ORIGIN.fullmatch(origin) is None:
                raise ValueError(f'"{origin}" is no origin such as https://tools.example.com')
        return value

    @field_validator("log_level", mode="before")
    @classmethod
    def _lower_level(cls, value: object) -> object:
        return value.lower() if isinstance(value, str) else value

    @model_validator(mode="after")
    def _tls_is_complete(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together: both are needed for TLS")
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise ValueError("tls_client_ca needs tls_certificate and tls_key as well")
        return self

    @model_validator(mode="after")
    def _queue_takes_a_call(self) -> Self:
        if self.max_queue_agents < self.max_agents:
            raise ValueError(
                "max_queue_agents must be at least max_agents, or a full request is never accepted"
            )
        return self

    @model_validator(mode="after")
    def _intake_takes_a_call(self) -> Self:
        if self.max_large_intake_bytes < self.max_request_bytes:
            raise ValueError(
                "max_intake_bytes must be at least 4/3 of max_request_bytes, or a full request is never"
                " accepted"
            )
        return self

    @property
    def max_large_intake_bytes(self) -> int:
        """Share of ``max_intake_bytes`` that large bodies may take; the rest is left to small ones."""
        return self.max_intake_bytes * 3 // 4

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return the sources by priority: flags, environment, the file that ``load`` names."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)


def load(config: Path | None = None, **flags: Any) -> Settings:
    """Return the settings from all sources.

    Args:
        config: the TOML file; None: the file that ``FORECAST_CONFIG`` names, if any.
        flags: the values of the command line; None: not given.

    Raises:
        SettingsError: a value is invalid, a variable is no setting, or the file does not exist.
    """
    unknown = unknown_variable(os.environ, Settings.model_fields)
    if unknown is not None:
        raise SettingsError(unknown)
    named = os.environ.get(CONFIG)
    file = config or (Path(named) if named else None)
    if file is not None and not file.is_file():
        raise SettingsError(f"no such configuration file: {file}")

    class FromFile(Settings):
        model_config = SettingsConfigDict(toml_file=file)

    given = {name: value for name, value in flags.items() if value is not None}
    try:
        settings = FromFile(**given)
    except ValidationError as error:
        raise SettingsError(
            "; ".join(_describe(problem, given, file) for problem in error.errors())
        ) from None
    except ValueError as error:  # the file is no valid TOML
        raise SettingsError(f"{file}: {error}") from None
    return settings


def _strip_token(token: object) -> object:
    """Return a token without surrounding blanks.

    Raises:
        ValueError: the token is empty.
    """
    if isinstance(token, SecretStr):
        token = token.get_secret_value()
    if not isinstance(token, str):
        return token
    stripped = token.strip()
    if not stripped:
        raise ValueError("one of the tokens is empty")
    return stripped


def _describe(problem: ErrorDetails, flags: Collection[str], file: Path | None) -> str:
    """Return a problem with the place of the value: a flag, a variable or the file.

    Args:
        problem: the problem.
        flags: the settings that flags give, which go before variables.
        file: the TOML file, the last source; None: there is none.
    """
    place = ".".join(map(str, problem["loc"])) or "settings"
    text = f"{place}: {problem['msg'].removeprefix('Value error, ')}"
    if not problem["loc"]:
        return text
    name = str(problem["loc"][0])
    if problem["type"] == "extra_forbidden":
        text = f"{name}: {no_such_setting(name, Settings.model_fields)}"
    variables = {variable.upper() for variable in os.environ}
    if name in flags:
        return text
    if PREFIX + name.upper() in variables:
        return f"{text} (in the variable {PREFIX}{name.upper()})"
    return text if file is None else f"{file}: {text}"


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT or [IPV6]:PORT.

    Raises:
        ValueError: the address has another form.
    """
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f'"{address}" is not HOST:PORT')
    return host.removeprefix("[").removesuffix("]"), int(port)


def split_shadow(shadow: str) -> tuple[str, float]:
    """Return model and share of ``name@version:share``.

    Raises:
        ValueError: it has another form, or the share is not above 0 and at most 1.
    """
    model, _, share = shadow.rpartition(":")
    try:
        number = float(share)
    except ValueError:
        number = 0.0
    if not model or not 0 < number <= 1:
        raise ValueError(f'"{shadow}" is not name@version:share with a share above 0 and up to 1')
    return model, number


def is_local(settings: Settings) -> bool:
    """Return whether both ports listen on this machine's loopback alone."""
    return is_loopback(settings.http) and is_loopback(settings.grpc)


def is_loopback(address: str) -> bool:
    """Return whether HOST:PORT can be reached from this machine alone."""
    host, _ = split_address(address)
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"  # what other names mean is up to a resolver


def bundled_models() -> Path | None:
    """Return the folder of the checkpoints in the package; None if there are none."""
    import model  # noqa: PLC0415 - only for its path

    folder = Path(next(iter(model.__path__))) / "checkpoints"
    return folder if folder.is_dir() else None
