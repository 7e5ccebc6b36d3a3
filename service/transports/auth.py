"""Bearer token authentication, the same on both transports."""

import hmac
from collections.abc import Sequence

from pydantic import SecretStr

from service.errors import Unauthenticated

_SCHEME = "bearer"


class Tokens:
    """The accepted bearer tokens. Without any, authentication is off."""

    def __init__(self, tokens: Sequence[SecretStr]) -> None:
        self._tokens = [token.get_secret_value().encode() for token in tokens]

    def check(self, authorization: str | None) -> None:
        """Refuse a call without a valid token.

        Args:
            authorization: the Authorization header; None: there is none.

        Raises:
            Unauthenticated: the token is missing or not accepted.
        """
        if not self._tokens:
            return
        if not authorization:
            raise Unauthenticated('credentials are missing: send "authorization: Bearer <token>"')
        scheme, _, token = authorization.partition(" ")
        given = token.strip().encode("utf-8", "surrogateescape")
        # Compare with all tokens, each in constant time, so that the timing reveals nothing about them.
        matches = [hmac.compare_digest(given, accepted) for accepted in self._tokens]
        if scheme.lower() != _SCHEME or not any(matches):
            raise Unauthenticated("the credentials are not valid")
