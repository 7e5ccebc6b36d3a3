"""Who may call."""

import hmac
from collections.abc import Sequence

from pydantic import SecretStr

from service.errors import Unauthenticated

_SCHEME = "bearer"


class Tokens:
    """The bearer tokens that are let in; none of them: everyone is."""

    def __init__(self, tokens: Sequence[SecretStr]) -> None:
        self._tokens = [token.get_secret_value().encode() for token in tokens]

    def check(self, authorization: str | None) -> None:
        """Lets a call in, or not.

        Args:
            authorization: the header of that name, if there is one.

        Raises:
            Unauthenticated: credentials are needed and these do not do.
        """
        if not self._tokens:
            return
        if not authorization:
            raise Unauthenticated('credentials are missing: send "authorization: Bearer <token>"')
        scheme, _, token = authorization.partition(" ")
        given = token.strip().encode("utf-8", "surrogateescape")
        # All are compared, each in constant time: the answer's timing tells nothing of them
        known = [hmac.compare_digest(given, expected) for expected in self._tokens]
        if scheme.lower() != _SCHEME or not any(known):
            raise Unauthenticated("these credentials are not known here")
