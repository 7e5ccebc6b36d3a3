"""Settings of the server: flags over ``FORECAST_*`` over a TOML file over defaults."""

import os
from collections.abc import Sequence
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

from service.environment import CONFIG, PREFIX, unknown_variable
from service.redis_url import parse_address

FALLBACK_MODEL = "constant-velocity-yaw"
"""The model of agents that the model asked for cannot forecast."""


class SettingsError(Exception):
    """The settings make no sense; the text says which and why."""


class Settings(BaseSettings):
    """What an operator can set. Every name is an environment variable too: ``http`` is ``FORECAST_HTTP``."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, protected_namespaces=())

    http: str = "127.0.0.1:8080"
    """HOST:PORT of REST; port 0 takes a free one."""
    grpc: str = "127.0.0.1:50051"
    """HOST:PORT of gRPC; port 0 takes a free one."""
    store: str = Field(default="memory", repr=False)
    """Where agents are remembered: "memory", in this process, or Redis 7 (see ``service.redis_url``):
    redis:// and rediss:// of one server, redis+sentinel:// and redis+cluster://."""
    store_budget_ms: float = Field(default=20.0, gt=0)
    """ms that a call waits for the track memory; later the forecast goes out without it."""
    store_timeout_ms: float = Field(default=500.0, gt=0)
    """ms after which Redis is taken not to answer at all."""
    store_connections: int = Field(default=16, ge=1)
    """Connections to each Redis server for calls, at most; those who watch have their own."""
    track_expiry: float = Field(default=30.0, ge=10.0)
    """s without a call of a scene after which it is forgotten."""
    max_tracked_agents: int = Field(default=5_000, ge=1)
    """Agents that this process has in memory; beyond it the scenes without a call for the longest time go.
    With Redis they are read again when they are called for."""
    models: Path | None = None
    """Folder of checkpoints; None: the bundled ones, if any."""
    default_model: str | None = None
    """The model of requests that name none; None: "cab" if loaded, else "kalman"."""
    allow_paper_protocol: bool = False
    """Load models trained by the paper protocol, too; they warn in every answer. Otherwise they are passed
    over, and a folder that holds no others is refused."""
    api_tokens: Annotated[tuple[SecretStr, ...], NoDecode] = ()
    """Bearer tokens that are let in; not set: everyone is. Comma-separated in the environment."""

    max_agents: int = Field(default=512, ge=1)
    """Agents of a request."""
    max_states: int = Field(default=512, ge=1)
    """Observations of an agent."""
    max_raster_pixels: int = Field(default=4096 * 4096, ge=1)
    """Rows × columns of a scene raster."""
    max_request_bytes: int = Field(default=16 * 2**20, ge=1024)
    """Size of a request, encoded."""
    max_samples: int = Field(default=2000, ge=1)
    """Samples of an agent."""
    max_samples_per_call: int = Field(default=100_000, ge=1)
    """Samples of all agents of a request."""

    max_batch_agents: int = Field(default=256, ge=1)
    """Agents in one forward."""
    max_queue_agents: int = Field(default=2048, ge=1)
    """Agents accepted but not yet in the model; beyond it calls are refused as overload."""
    max_timeout: float = Field(default=30.0, gt=0)
    """s that a call may take, whatever deadline it brings."""
    drain_seconds: float = Field(default=10.0, ge=0)
    """s that accepted calls are given when the server stops."""
    threads: int | None = Field(default=None, ge=1)
    """Threads of the forward; None: the physical cores."""

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe level that is logged."""
    log_json: bool = False
    """Logs as JSON lines."""

    @field_validator("http", "grpc")
    @classmethod
    def _is_address(cls, value: str) -> str:
        split_address(value)
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
            # A comma at the end is no token. Nothing but commas is none at all, which would let everyone
            # in where someone meant to let in a few: an empty secret, say.
            tokens = tuple(token.strip() for token in value.split(",") if token.strip())
            if not tokens:
                raise ValueError("is set but names no token; leave it out to let everyone in")
            return tokens
        if isinstance(value, Sequence):
            return tuple(_strip_token(token) for token in value)
        return value

    @field_validator("log_level", mode="before")
    @classmethod
    def _lower_level(cls, value: object) -> object:
        return value.lower() if isinstance(value, str) else value

    @model_validator(mode="after")
    def _queue_takes_a_call(self) -> Self:
        if self.max_queue_agents < self.max_agents:
            raise ValueError("max_queue_agents must be at least max_agents, or a full request never gets in")
        return self

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags, the environment, the file that ``load`` names; the first that gives a value wins."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)


def load(config: Path | None = None, **flags: Any) -> Settings:
    """Settings from all sources.

    Args:
        config: TOML file; default: the one that ``FORECAST_CONFIG`` names, if it does.
        flags: what the command line gives; None counts as not given.

    Raises:
        SettingsError: a value is wrong, a variable sets nothing, or the file is not there.
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
        raise SettingsError("; ".join(_describe(problem) for problem in error.errors())) from None
    except ValueError as error:  # a file that is no TOML
        raise SettingsError(f"{file}: {error}") from None
    return settings


def _strip_token(token: object) -> object:
    """A token without the blanks around it.

    Raises:
        ValueError: nothing else is left.
    """
    if isinstance(token, SecretStr):
        token = token.get_secret_value()
    if not isinstance(token, str):
        return token
    stripped = token.strip()
    if not stripped:
        raise ValueError("one of the tokens is empty")
    return stripped


def _describe(problem: ErrorDetails) -> str:
    place = ".".join(map(str, problem["loc"])) or "settings"
    return f"{place}: {problem['msg'].removeprefix('Value error, ')}"


def split_address(address: str) -> tuple[str, int]:
    """Host and port of HOST:PORT or [IPV6]:PORT.

    Raises:
        ValueError: it is neither.
    """
    host, colon, port = address.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > 65535:
        raise ValueError(f'"{address}" is not HOST:PORT')
    return host.removeprefix("[").removesuffix("]"), int(port)


def bundled_models() -> Path | None:
    """Folder of the checkpoints that come with the package; None when there are none."""
    import model  # noqa: PLC0415 - for its place alone

    folder = Path(next(iter(model.__path__))) / "checkpoints"
    return folder if folder.is_dir() else None
