"""Authentication: from the Authorization header of a call to its caller."""

import base64
import binascii
import hmac
from collections.abc import Sequence
from contextlib import suppress

import structlog

from service.access.caller import Caller
from service.access.key_file import Key, KeyFileError, digest, read_keys
from service.access.scopes import Scope
from service.access.watched import Watched
from service.errors import Unauthenticated
from service.settings import Settings, SettingsError, is_local, is_loopback
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

TOKENS_NAME = "(api_tokens)"
"""Name, in metrics, of all callers with a token of ``Settings.api_tokens``; no key can have it."""
_ALL_SCOPES = tuple(Scope)
_OPEN_SCOPES = tuple(scope for scope in Scope if scope is not Scope.ADMIN)
"""Scopes of callers without a key where other machines can call."""


class Gate:
    """Keys that are let in. Without any, everyone is; ``require_protection`` tells where that is allowed."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        """
        Args:
            settings: name the file of keys, and tokens.
            metrics: count the calls of each key.

        Raises:
            SettingsError: the file of keys is missing or broken.
        """
        self._metrics = metrics
        self._anyone = Caller(_unlimited("anyone", _ALL_SCOPES if is_local(settings) else _OPEN_SCOPES))
        self._tokens: dict[str, Caller] = {}
        if settings.api_tokens:
            holder = Caller(_unlimited(TOKENS_NAME, _ALL_SCOPES), metrics)
            self._tokens = {digest(token.get_secret_value()): holder for token in settings.api_tokens}
        self._keys: dict[str, Caller] = {}
        self._file: Watched[tuple[Key, ...]] | None = None
        if settings.keys_file is not None:
            path = settings.keys_file
            try:
                self._file = Watched("keys", [path], lambda: read_keys(path))
            except KeyFileError as error:
                raise SettingsError(f"keys_file: {error}") from error
            self._apply(self._file.value)

    @property
    def closed(self) -> bool:
        """True if callers need a key or token."""
        return bool(self._tokens) or self._file is not None

    @property
    def broken(self) -> bool:
        """True if the file of keys has changed and cannot be read, so that the former keys are let in."""
        return self._file is not None and self._file.broken

    def refresh(self) -> bool:
        """Read the file of keys again if it changed, in any thread; if this is True, ``apply`` them."""
        return self._file is not None and self._file.refresh()

    def apply(self) -> None:
        """Let in the keys that were read last, and no others."""
        if self._file is not None:
            self._apply(self._file.value)

    def identify(self, authorization: str | None, *, basic: bool = False) -> Caller:
        """Return the caller of a call.

        Args:
            authorization: the Authorization header; None: there is none.
            basic: also accept the key as the password of HTTP's Basic scheme, which browsers ask for.

        Raises:
            Unauthenticated: the key is missing or not accepted.
        """
        if not self.closed:
            return self._anyone
        if not authorization:
            raise Unauthenticated('credentials are missing: send "authorization: Bearer <key>"')
        key = _key_in(authorization, basic)
        given = digest(key)
        # Compare with all keys, each in constant time, so that the timing reveals nothing about them.
        found = [
            caller
            for accepted, caller in (*self._keys.items(), *self._tokens.items())
            if hmac.compare_digest(given, accepted)
        ]
        if key and found:
            return found[0]
        raise Unauthenticated("the credentials are not valid")

    def _apply(self, keys: Sequence[Key]) -> None:
        former, self._keys = self._keys, {}
        for key in keys:
            caller = former.pop(key.sha256, None)
            if caller is None:
                caller = Caller(key, self._metrics)
            else:
                caller.change(key)
            self._keys[key.sha256] = caller
        for caller in former.values():
            caller.revoke()
        tokens = (TOKENS_NAME,) if self._tokens else ()
        self._metrics.keys.keep([*(key.name for key in keys), *tokens])
        if not self._keys and not self._tokens:
            _log.warning("no keys: nobody is let in")


def require_protection(settings: Settings) -> None:
    """Refuse settings by which other machines could call without a key.

    Raises:
        SettingsError: a port is open to other machines, and neither keys nor tokens are set, nor is
            ``allow_anyone``.
    """
    if settings.keys_file is not None or settings.api_tokens or settings.allow_anyone:
        return
    for name in ("http", "grpc"):
        address = getattr(settings, name)
        if not is_loopback(address):
            raise SettingsError(
                f"{name}: {address} can be reached from other machines, and no keys are set, so anyone could"
                " call. Make a key with `cab-forecast keys add` and set FORECAST_KEYS_FILE, or set"
                " FORECAST_ALLOW_ANYONE=true"
            )


def _unlimited(name: str, scopes: tuple[Scope, ...]) -> Key:
    """Return a key without limits, of a name that no file can hold."""
    return Key.model_construct(
        name=name, sha256="", scopes=scopes, agents_per_second=None, concurrent_agents=None, streams=None
    )


def _key_in(authorization: str, basic: bool) -> str:
    """Return the key of an Authorization header; an empty text if it has another form."""
    scheme, _, text = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return text.strip()
    if basic and scheme.lower() == "basic":
        with suppress(binascii.Error, UnicodeDecodeError):
            return base64.b64decode(text.strip(), validate=True).decode().partition(":")[2]
    return ""
