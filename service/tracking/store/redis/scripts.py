"""Lua scripts that run in Redis, each loaded once and again when Redis has forgotten it."""

import hashlib
from collections.abc import Sequence
from importlib import resources
from typing import Any

from redis.exceptions import NoScriptError


class Script:
    """One script of this package.

    Args:
        name: of its file.
    """

    def __init__(self, name: str) -> None:
        self._text = (resources.files("service.tracking.store.redis") / name).read_text(encoding="utf-8")
        self._digest = hashlib.sha1(self._text.encode(), usedforsecurity=False).hexdigest()

    async def run(self, client: Any, keys: Sequence[str], arguments: Sequence[str | bytes | int]) -> Any:
        """Runs it: one round trip, two where Redis did not know it.

        Args:
            client: of redis.asyncio, of one server or of a cluster.
            keys: all in one slot.
            arguments: whatever the script takes.

        Raises:
            redis.exceptions.RedisError, OSError: there is no answer.
        """
        try:
            return await client.evalsha(self._digest, len(keys), *keys, *arguments)
        except NoScriptError:
            return await client.eval(self._text, len(keys), *keys, *arguments)
