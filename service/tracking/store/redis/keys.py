"""Names of a scene's keys in Redis.

What is in braces decides where a Redis Cluster puts a key: all of one scene lie together, so that one script
reaches them.
"""

from urllib.parse import quote

_PREFIX = "cab:1"
"""Of this layout; another one takes another number."""


class SceneKeys:
    """Keys of one scene."""

    def __init__(self, scene_id: str) -> None:
        # Quoted, a name has no brace that would end the part in braces early, and no colon
        self._scene = f"{_PREFIX}:{{{quote(scene_id, safe='')}}}"

    @property
    def log(self) -> str:
        """Hash of the calls of the last seconds."""
        return f"{self._scene}:log"

    @property
    def watched(self) -> str:
        """There while somebody watches."""
        return f"{self._scene}:watched"

    @property
    def events(self) -> str:
        """Stream for those who watch."""
        return f"{self._scene}:events"

    @property
    def published(self) -> str:
        """How many events there were."""
        return f"{self._scene}:published"
