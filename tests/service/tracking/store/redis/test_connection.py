"""Clients of real servers: commands, failures, and that no call gets the reply of another one."""

import asyncio
import random
import shutil
import subprocess
import time
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any, cast

import pytest
from redis import exceptions as redis_errors
from redis.asyncio.cluster import ClusterNode
from redis.asyncio.sentinel import SentinelConnectionPool

from loadtest import redis_servers
from loadtest.redis_servers import HOST, Cluster, FaultProxy, Process, Sentinels
from service.redis_url import Endpoint, Layout, RedisAddress, parse_address
from service.tracking.store.redis import cluster
from service.tracking.store.redis.connection import CLIENT_NAME, connect

LAYOUTS = ("redis_server", "redis_sentinels", "redis_cluster")
ECHO = "return ARGV[1]"


@asynccontextmanager
async def connected(
    url: str | RedisAddress, timeout_s: float = 2.0, connections: int = 4
) -> AsyncIterator[Any]:
    """Open a client."""
    address = parse_address(url) if isinstance(url, str) else url
    client = connect(address, timeout_s=timeout_s, connections=connections)
    try:
        yield client
    finally:
        await client.aclose()


async def echo(client: Any, number: int) -> None:
    """Make a call whose reply no other call may get; its key can be in any slot."""
    value = b"%d" % number
    assert await client.eval(ECHO, 1, f"key {number}", value) == value


@pytest.fixture(params=LAYOUTS)
def url(request: pytest.FixtureRequest) -> str:
    """Return a URL of each layout."""
    servers: Process | Cluster | Sentinels = request.getfixturevalue(request.param)
    return servers.url


@asynccontextmanager
async def behind_a_network(
    request: pytest.FixtureRequest, layout: str, timeout_s: float, connections: int = 4
) -> AsyncIterator[tuple[Any, list[FaultProxy]]]:
    """Open a client whose connections to the data go through proxies; yield it and the proxies."""
    servers: Process | Cluster | Sentinels = request.getfixturevalue(layout)
    with ExitStack() as stack:
        if isinstance(servers, Cluster):
            ports = {node.port: stack.enter_context(FaultProxy(node.port)) for node in servers.nodes}
            client: Any = cluster.Cluster(
                [Endpoint(HOST, proxy.port) for proxy in ports.values()],
                connections=connections,
                timeout_s=timeout_s,
                protocol=2,
                socket_timeout=timeout_s,
                socket_connect_timeout=timeout_s,
                address_remap=lambda node: (node[0], ports[node[1]].port if node[1] in ports else node[1]),
            )
            proxies = list(ports.values())
        else:
            server = servers.master if isinstance(servers, Sentinels) else servers
            proxy = stack.enter_context(FaultProxy(server.port))
            proxies = [proxy]
            if isinstance(servers, Sentinels):
                client = connect(parse_address(servers.url), timeout_s=timeout_s, connections=connections)
                pool = cast(SentinelConnectionPool, client.connection_pool)

                async def discover(_: str) -> tuple[str, int]:
                    return HOST, proxy.port

                pool.sentinel_manager.discover_master = discover
            else:
                client = connect(parse_address(proxy.url), timeout_s=timeout_s, connections=connections)
        try:
            yield client, proxies
        finally:
            await client.aclose()


async def test_values_are_bytes(url: str) -> None:
    value = bytes(range(256)) * 300
    async with connected(url) as client:
        await client.set("bytes", value, px=10_000)
        assert await client.get("bytes") == value
        assert await client.eval("return {ARGV[1], 1, false}", 1, "bytes", value) == [value, 1, None]


async def test_the_server_is_told_who_we_are(url: str) -> None:
    async with connected(url) as client:
        node = {"target_nodes": client.RANDOM} if isinstance(client, cluster.Cluster) else {}
        told = await client.execute_command("CLIENT INFO", **node)
        assert told["name"] == CLIENT_NAME
        assert told["resp"] == "2"


async def test_nothing_is_sent_before_the_first_command(redis_proxy: FaultProxy) -> None:
    for layout in Layout:
        address = RedisAddress(layout, (Endpoint(HOST, redis_proxy.port),), master_name="tracks")
        async with connected(address):
            await asyncio.sleep(0.01)
    assert redis_proxy.accepted == 0


async def test_a_database(redis_server: Process) -> None:
    async with connected(f"{redis_server.url}/3") as client:
        assert (await client.client_info())["db"] == 3


async def test_credentials() -> None:
    with redis_servers.single("--user", "före", "on", ">p@ss/word", "~*", "+@all", password="x") as one:  # noqa: S106
        place = f"{HOST}:{one.port}"
        for credentials in ("f%C3%B6re:p%40ss%2Fword@", ":x@", "default:x@"):
            async with connected(f"redis://{credentials}{place}") as client:
                assert await client.ping()
        for credentials in ("", ":y@", "nobody:x@"):
            async with connected(f"redis://{credentials}{place}") as client:
                with pytest.raises((redis_errors.AuthenticationError, redis_errors.ConnectionError)):
                    await client.ping()


async def test_nobody_there_is_an_error_at_once() -> None:
    with redis_servers.single() as gone:
        pass
    for layout in Layout:
        address = RedisAddress(layout, (Endpoint(HOST, gone.port),), master_name="tracks")
        async with connected(address, timeout_s=30) as client:
            with pytest.raises((redis_errors.RedisError, redis_errors.RedisClusterException)):
                await client.get("key")


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_a_network_that_hangs_is_an_error_after_the_timeout(
    request: pytest.FixtureRequest, layout: str
) -> None:
    async with behind_a_network(request, layout, timeout_s=0.1) as (client, proxies):
        await echo(client, 0)
        for proxy in proxies:
            proxy.set("stall")
        started = time.perf_counter()
        results = await asyncio.gather(*(echo(client, n) for n in range(12)), return_exceptions=True)
        assert time.perf_counter() - started < 3
        assert not any(isinstance(result, AssertionError) or result is None for result in results)
        for proxy in proxies:
            proxy.set("pass")
        await recovered(client)


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_lost_connections_are_made_anew(request: pytest.FixtureRequest, layout: str) -> None:
    async with behind_a_network(request, layout, timeout_s=2) as (client, proxies):
        await asyncio.gather(*(echo(client, n) for n in range(12)))
        for proxy in proxies:
            proxy.set("close")
        results = await asyncio.gather(*(echo(client, n) for n in range(12)), return_exceptions=True)
        assert all(isinstance(result, Exception) for result in results)
        assert not any(isinstance(result, AssertionError | AttributeError) for result in results)
        for proxy in proxies:
            proxy.set("pass")
        await recovered(client)


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_commands_wait_for_a_connection(request: pytest.FixtureRequest, layout: str) -> None:
    async with behind_a_network(request, layout, timeout_s=5, connections=2) as (client, proxies):
        for proxy in proxies:
            proxy.set("slow", 0.005)
        await asyncio.gather(*(echo(client, n) for n in range(20)))
        # A cluster's client asks for the topology over a connection of its own
        most = 3 if layout == "redis_cluster" else 2
        assert max(proxy.max_connections for proxy in proxies) <= most


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_they_do_not_wait_for_long(request: pytest.FixtureRequest, layout: str) -> None:
    async with behind_a_network(request, layout, timeout_s=0.3, connections=1) as (client, proxies):
        await echo(client, 0)
        for proxy in proxies:
            proxy.set("slow", 0.2)
        started = time.perf_counter()
        results = await asyncio.gather(*(echo(client, 0) for _ in range(8)), return_exceptions=True)
        assert time.perf_counter() - started < 3
        assert sum(isinstance(result, redis_errors.ConnectionError) for result in results) >= 4


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_no_cancelled_call_leaves_its_reply_to_another(
    request: pytest.FixtureRequest, layout: str
) -> None:
    chance = random.Random(20)
    loop = asyncio.get_running_loop()
    async with behind_a_network(request, layout, timeout_s=5) as (client, proxies):
        for proxy in proxies:
            proxy.set("slow", (0, 0.004))
        await echo(client, 0)
        answered = 0
        for turn in range(40):
            calls = [asyncio.create_task(echo(client, 100 * turn + n)) for n in range(12)]
            for call in calls:
                loop.call_later(chance.uniform(0, 0.05), call.cancel)
            results = await asyncio.gather(*calls, return_exceptions=True)
            assert not any(isinstance(result, AssertionError) for result in results)
            answered += sum(result is None for result in results)
        assert 20 < answered < 460
        for proxy in proxies:
            proxy.set("pass")
        await recovered(client)
        await asyncio.gather(*(echo(client, n) for n in range(100)))


@pytest.mark.parametrize("layout", LAYOUTS)
async def test_no_call_that_timed_out_leaves_its_reply_to_another(
    request: pytest.FixtureRequest, layout: str
) -> None:
    async with behind_a_network(request, layout, timeout_s=0.02) as (client, proxies):
        answered = failed = 0
        for turn in range(20):
            for proxy in proxies:
                proxy.set("slow", (0, 0.02))
            calls = (echo(client, 100 * turn + n) for n in range(8))
            results = await asyncio.gather(*calls, return_exceptions=True)
            assert not any(isinstance(result, AssertionError) for result in results)
            answered += sum(result is None for result in results)
            failed += sum(result is not None for result in results)
            for proxy in proxies:
                proxy.set("pass")
            await recovered(client)
        assert failed > 20
        await asyncio.gather(*(echo(client, n) for n in range(16)))


async def recovered(client: Any) -> None:
    """Wait until several calls in a row are answered, whatever the slots of their keys."""
    async with asyncio.timeout(20):
        good = 0
        while good < 20:
            try:
                await echo(client, good)
                good += 1
            except (redis_errors.RedisError, redis_errors.RedisClusterException, TimeoutError):
                good = 0
                await asyncio.sleep(0.01)


async def test_a_new_master_takes_over() -> None:
    with redis_servers.sentinels() as servers:
        async with connected(servers.url, timeout_s=0.5) as client:
            await asyncio.gather(*(client.set(f"key {n}", n) for n in range(8)))
            servers.master.kill()
            await recovered(client)
            await client.set("key", "after")
            assert servers.replica.text("GET", "key") == "after"


async def test_a_master_that_hangs_is_replaced() -> None:
    with redis_servers.sentinels() as servers:
        async with connected(servers.url, timeout_s=0.2) as client:
            await asyncio.gather(*(client.set(f"key {n}", n) for n in range(8)))
            servers.master.pause()
            await recovered(client)
            await client.set("key", "after")
            servers.master.resume()
            assert servers.replica.text("GET", "key") == "after"


async def test_a_demoted_master_is_left() -> None:
    with redis_servers.sentinels() as servers:
        async with connected(servers.url, timeout_s=0.5) as client:
            await asyncio.gather(*(client.set(f"key {n}", n) for n in range(8)))
            servers.sentinels[0].command("SENTINEL FAILOVER", redis_servers.MASTER_NAME)
            redis_servers.until(lambda: "role:master" in servers.replica.text("INFO"))
            servers.master.command("REPLICAOF", HOST, servers.replica.port)  # a Sentinel takes 10 s to do so
            await written(client)
            assert servers.replica.text("GET", "key") == "after"


async def written(client: Any) -> None:
    """Wait until a value could be written."""
    async with asyncio.timeout(20):
        while True:
            with suppress(redis_errors.RedisError, redis_errors.RedisClusterException):
                if await client.set("key", "after"):
                    return
            await asyncio.sleep(0.05)


async def test_a_replica_takes_over_in_a_cluster() -> None:
    with redis_servers.cluster() as servers:
        async with connected(servers.url, timeout_s=0.5) as client:
            await asyncio.gather(*(echo(client, n) for n in range(50)))
            servers.nodes[0].kill()
            await recovered(client)
            servers.nodes[1].pause()
            await recovered(client)
            servers.nodes[1].resume()


async def test_calls_that_find_a_cluster_dead_share_one_look_at_it() -> None:
    with redis_servers.cluster() as servers:
        async with connected(servers.url, timeout_s=0.3, connections=16) as client:
            await asyncio.gather(*(echo(client, n) for n in range(50)))
            for node in servers.nodes:
                node.pause()
            started = time.perf_counter()
            for _ in range(2):
                results = await asyncio.gather(*(echo(client, n) for n in range(16)), return_exceptions=True)
                assert all(isinstance(result, Exception) for result in results)
            assert time.perf_counter() - started < 4
            for node in servers.nodes:
                node.resume()
            await recovered(client)


async def test_a_look_at_a_cluster_that_nobody_waits_for_ends_before_it_is_closed(
    request: pytest.FixtureRequest,
) -> None:
    async with behind_a_network(request, "redis_cluster", timeout_s=0.1) as (client, proxies):
        for proxy in proxies:
            proxy.set("stall")
        call = asyncio.create_task(echo(client, 0))
        await asyncio.sleep(0.01)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        await client.aclose()
        nodes = [*client.nodes_manager.startup_nodes.values(), *client.nodes_manager.nodes_cache.values()]
        assert sum(proxy.accepted for proxy in proxies) > 0
        assert not any(connection.is_connected for node in nodes for connection in node._connections)


async def test_the_given_nodes_are_asked_when_all_known_ones_have_gone(redis_cluster: Cluster) -> None:
    with redis_servers.single() as gone:
        pass
    async with connected(redis_cluster.url, timeout_s=0.5) as client:
        await echo(client, 0)
        manager = client.nodes_manager
        await manager.aclose("startup_nodes")
        stale = ClusterNode(HOST, gone.port)
        manager.startup_nodes = {stale.name: stale}
        await client.aclose()
        with pytest.raises(redis_errors.RedisClusterException):
            await echo(client, 0)
        await echo(client, 0)
        assert stale.name not in manager.startup_nodes


async def test_scripts_need_no_list_of_all_commands(redis_cluster: Cluster) -> None:
    for node in redis_cluster.nodes:
        node.command("CONFIG RESETSTAT")
    async with connected(redis_cluster.url) as client:
        await asyncio.gather(*(echo(client, n) for n in range(50)))
        assert not any("cmdstat_command:" in node.text("INFO commandstats") for node in redis_cluster.nodes)
        await asyncio.gather(*(client.get(f"key {n}") for n in range(50)))
        told = [node.text("INFO commandstats") for node in redis_cluster.nodes]
        assert sum("cmdstat_command:calls=1" in one for one in told) == 1


async def test_redirections_are_followed(redis_cluster: Cluster) -> None:
    key = "{redirected}"
    async with connected(redis_cluster.url) as client:
        await asyncio.gather(*(echo(client, n) for n in range(100)))
        slot = client.keyslot(key)
        source = client.get_node_from_key(key)
        target = next(node for node in client.get_primaries() if node != source)
        assert len(target._free) > 1
        names = {node: (await node.execute_command("CLUSTER MYID")).decode() for node in (source, target)}
        move = ("CLUSTER", "SETSLOT", slot)
        await target.execute_command(*move, "IMPORTING", names[source])
        await source.execute_command(*move, "MIGRATING", names[target])
        for number in range(20):  # ASK
            await client.set(f"{key}{number}", number)
        await asyncio.gather(*(client.set(f"{key}{number}", number) for number in range(20)))
        for node in (target, source):
            await node.execute_command(*move, "NODE", names[target])
        for number in range(20):  # MOVED
            assert await client.get(f"{key}{number}") == b"%d" % number
        assert client.get_node_from_key(key) == target


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    """Create a self-signed certificate for this machine and return its folder."""
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("openssl is not installed")
    words = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test"]
    words += ["-addext", f"subjectAltName=IP:{HOST}", "-keyout", "key.pem", "-out", "cert.pem"]
    subprocess.run([program, *words], check=True, cwd=tmp_path, capture_output=True)  # noqa: S603
    return tmp_path


async def test_tls(certificates: Path) -> None:
    port = redis_servers.free_port()
    options = ["--tls-port", str(port), "--tls-auth-clients", "no"]
    options += [
        "--tls-cert-file",
        str(certificates / "cert.pem"),
        "--tls-key-file",
        str(certificates / "key.pem"),
    ]
    options += ["--tls-ca-cert-file", str(certificates / "cert.pem")]
    with redis_servers.single(*options):
        url = f"rediss://{HOST}:{port}"
        async with connected(f"{url}?ca_file={certificates / 'cert.pem'}") as client:
            assert await client.ping()
        async with connected(url) as client:
            with pytest.raises(redis_errors.ConnectionError, match="certificate"):
                await client.ping()


def test_a_file_of_authorities_that_is_none_is_an_error_at_once(tmp_path: Path) -> None:
    empty = tmp_path / "empty.pem"
    empty.touch()
    for file in (tmp_path / "none.pem", empty):
        for scheme in ("rediss", "rediss+sentinel", "rediss+cluster"):
            address = parse_address(
                f"{scheme}://{HOST}{'/tracks' * (scheme[6:] == '+sentinel')}?ca_file={file}"
            )
            with pytest.raises(OSError, match=r"none.pem|SSL|No such file|certificate"):
                connect(address, timeout_s=1, connections=1)
