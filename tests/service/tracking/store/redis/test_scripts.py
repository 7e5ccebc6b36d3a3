"""Names of keys, and scripts that Redis has forgotten."""

import pytest
from redis.exceptions import NoScriptError, ResponseError

from service.tracking.store.redis.scripts import SceneKeys, Script


def test_the_names_of_keys_do_not_change() -> None:
    keys = SceneKeys("Kreuzung 1")
    assert [keys.log, keys.watched, keys.events, keys.published] == [
        "cab:1:{Kreuzung%201}:log",
        "cab:1:{Kreuzung%201}:watched",
        "cab:1:{Kreuzung%201}:events",
        "cab:1:{Kreuzung%201}:published",
    ]


@pytest.mark.parametrize("scene_id", ["}", "{", "a}b{c", ":", "x:log"])
def test_no_id_ends_the_part_in_braces_early(scene_id: str) -> None:
    log = SceneKeys(scene_id).log
    assert log.count("{") == log.count("}") == 1
    assert log.count(":") == 3


class FakeClient:
    """Client that knows no script, or fails."""

    def __init__(self, error: Exception) -> None:
        self.error = error
        self.evaluated: list[tuple[object, ...]] = []

    async def evalsha(self, *_: object) -> None:
        raise self.error

    async def eval(self, *words: object) -> str:
        self.evaluated.append(words)
        return "reply"


async def test_a_script_that_redis_does_not_know_is_sent_whole() -> None:
    client = FakeClient(NoScriptError())
    assert await Script("publish.lua").run(client, ["a", "b"], [1, b"2"]) == "reply"
    ((text, *rest),) = client.evaluated
    assert "XADD" in str(text)
    assert rest == [2, "a", "b", 1, b"2"]


async def test_another_error_is_raised() -> None:
    client = FakeClient(ResponseError("OOM"))
    with pytest.raises(ResponseError):
        await Script("append.lua").run(client, ["a", "b"], [])
    assert client.evaluated == []
