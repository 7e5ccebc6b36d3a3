"""Keys of a scene in Redis and the Lua scripts that use them."""

import hashlib
from collections.abc import Sequence
from importlib import resources
from typing import Any
from urllib.parse import quote

from redis.exceptions import NoScriptError

_PREFIX = "cab:1"
"""Number of this layout; another layout gets another number."""


class SceneKeys:
    """Keys of one scene.

    The part in braces selects the slot in a Redis Cluster: all keys of a scene are in one slot, so that one
    script can use them.
    """

    def __init__(self, scene_id: str) -> None:
        # A quoted id has no brace, which would end the part in braces, and no colon
        self._scene = f"{_PREFIX}:{{{quote(scene_id, safe='')}}}"

    @property
    def log(self) -> str:
        """Hash of the calls of the last seconds."""
        return f"{self._scene}:log"

    @property
    def watched(self) -> str:
        """Flag that exists while the scene has a watcher."""
        return f"{self._scene}:watched"

    @property
    def events(self) -> str:
        """Stream of the events for watchers."""
        return f"{self._scene}:events"

    @property
    def published(self) -> str:
        """Number of events published so far."""
        return f"{self._scene}:published"

    @property
    def frames(self) -> str:
        """Stream of the frames for watchers."""
        return f"{self._scene}:frames"

    def map(self, digest: bytes) -> str:
        """Map for watchers, by its digest."""
        return f"{self._scene}:map:{digest.hex()}"


class Script:
    """Lua script; it is loaded again if Redis has forgotten it.

    Args:
        name: file name.
        package: package that contains the file.
    """

    def __init__(self, name: str, package: str = "service.tracking.store.redis") -> None:
        self._text = (resources.files(package) / name).read_text(encoding="utf-8")
        self._digest = hashlib.sha1(self._text.encode(), usedforsecurity=False).hexdigest()

    async def run(self, client: Any, keys: Sequence[str], arguments: Sequence[str | bytes | int]) -> Any:
        """Run the script: one round trip, or two if Redis did not know it.

        Args:
            client: client of redis.asyncio, for one server or a cluster.
            keys: keys, all in one slot.
            arguments: arguments of the script.

        Returns:
            The script's reply, as redis-py decodes it.

        Raises:
            redis.exceptions.RedisError, OSError: Redis failed or cannot be reached.
        """
        try:
            return await client.evalsha(self._digest, len(keys), *keys, *arguments)
        except NoScriptError:
            return await client.eval(self._text, len(keys), *keys, *arguments)
