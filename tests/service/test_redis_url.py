"""Addresses of Redis: what they say, what is refused, and that no password gets out."""

# ruff: noqa: S105, S106 - they open nothing

from dataclasses import replace
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.redis_url import Endpoint, Layout, RedisAddress, parse_address

_words = st.text(st.characters(codec="utf-8"), min_size=1)
_hosts = st.one_of(
    st.from_regex(r"[A-Za-z0-9._-]{1,20}", fullmatch=True),
    st.ip_addresses(v=4).map(str),
    st.ip_addresses(v=6).map(str),
)
_endpoints = st.builds(Endpoint, _hosts, st.integers(1, 65535))


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("redis://cache", RedisAddress(Layout.SINGLE, (Endpoint("cache", 6379),))),
        ("REDIS://cache/", RedisAddress(Layout.SINGLE, (Endpoint("cache", 6379),))),
        (
            "redis://fore:p%40ss%2F@10.0.0.1:7000/3",
            RedisAddress(
                Layout.SINGLE, (Endpoint("10.0.0.1", 7000),), user="fore", password="p@ss/", database=3
            ),
        ),
        (
            "redis://:a:b@c@cache",
            RedisAddress(Layout.SINGLE, (Endpoint("cache", 6379),), password="a:b@c"),
        ),
        (
            "rediss://[2001:db8::1]:7000?ca_file=/etc/ca%20files/a.pem",
            RedisAddress(
                Layout.SINGLE, (Endpoint("2001:db8::1", 7000),), tls=True, ca_file="/etc/ca files/a.pem"
            ),
        ),
        (
            "redis+sentinel://s1,s2:1234,[::1]/tracks",
            RedisAddress(
                Layout.SENTINEL,
                (Endpoint("s1", 26379), Endpoint("s2", 1234), Endpoint("::1", 26379)),
                master_name="tracks",
            ),
        ),
        (
            "rediss+sentinel://u:p@s1/tracks/2?sentinel_username=a&sentinel_password=b%26&ca_file=ca.pem",
            RedisAddress(
                Layout.SENTINEL,
                (Endpoint("s1", 26379),),
                tls=True,
                ca_file="ca.pem",
                user="u",
                password="p",
                database=2,
                master_name="tracks",
                sentinel_user="a",
                sentinel_password="b&",
            ),
        ),
        (
            "redis+cluster://:p@n1,n2:7001",
            RedisAddress(Layout.CLUSTER, (Endpoint("n1", 6379), Endpoint("n2", 7001)), password="p"),
        ),
        ("rediss+cluster://n1/", RedisAddress(Layout.CLUSTER, (Endpoint("n1", 6379),), tls=True)),
    ],
)
def test_what_a_url_says(text: str, address: RedisAddress) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "begins with redis://"),
        ("cache:6379", "begins with redis://"),
        ("http://cache", "begins with redis://"),
        ("redis+sentinel+cluster://cache", "begins with redis://"),
        ("unix:///run/redis.sock", "begins with redis://"),
        ("redis://", "no valid host"),
        ("redis://:6379", "no valid host"),
        ("redis://ca che", "no blanks"),
        ("redis://cache\n", "no blanks"),
        ("redis://käse", "no valid host"),
        ("redis://::1", "no valid host"),
        ("redis://[::1", "no valid host"),
        ("redis://[::1]6379", "no valid host"),
        ("redis://[cache]", "no valid host"),
        ("redis://cache:", "the port"),
        ("redis://cache:0", "the port"),
        ("redis://cache:65536", "the port"),
        ("redis://cache:+1", "the port"),
        ("redis://cache:٣", "the port"),
        ("redis://cache:1" + "0" * 5000, "the port"),
        ("redis://cache/x", "no number of a database"),
        ("redis://cache/-1", "no number of a database"),
        ("redis://cache/1/2", "no number of a database"),
        ("redis://a,b", "several hosts"),
        ("redis+cluster://a,", "no valid host"),
        ("redis+cluster://a/1", "has no path"),
        ("redis+sentinel://a", "the master's name"),
        ("redis+sentinel://a//1", "the master's name"),
        ("redis+sentinel://a/tr%61cks", "the master's name"),
        ("redis+sentinel://a/tracks/x", "no number of a database"),
        ("redis://user@cache", "no password before"),
        ("redis://@cache", "no password before"),
        ("redis://user:@cache", "no password before"),
        ("redis://:50%@cache", "encodes nothing"),
        ("redis://:%FF@cache", "no UTF-8"),
        ("redis://:a#b@cache", "%23"),
        ("redis://cache?db=1", "no other parameters"),
        ("redis://cache?ca_file=/ca.pem", "no other parameters"),
        ("redis://cache?sentinel_password=p", "no other parameters"),
        ("rediss://cache?ca_file", "one value"),
        ("rediss://cache?ca_file=", "one value"),
        ("rediss://cache?ca_file=a&ca_file=b", "one value"),
        ("redis+sentinel://a/tracks?sentinel_username=u", "no sentinel_password"),
    ],
)
def test_what_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        parse_address(text)


@given(
    user=st.none() | _words,
    password=_words,
    layout=st.sampled_from(Layout),
    tls=st.booleans(),
    database=st.integers(0, 999_999_999),
    sentinel_password=st.none() | _words,
    data=st.data(),
)
def test_everything_comes_back(
    user: str | None,
    password: str,
    layout: Layout,
    tls: bool,
    database: int,
    sentinel_password: str | None,
    data: st.DataObject,
) -> None:
    endpoints = tuple(
        data.draw(st.lists(_endpoints, min_size=1, max_size=1 if layout is Layout.SINGLE else 4))
    )
    address = RedisAddress(
        layout,
        endpoints,
        tls,
        user=user,
        password=password,
        database=0 if layout is Layout.CLUSTER else database,
        master_name="tracks" if layout is Layout.SENTINEL else "",
    )
    credentials = f"{quote(user or '', safe='')}:{quote(password, safe='')}@"
    text = str(address).replace("://", f"://{credentials}", 1)
    if layout is Layout.SENTINEL and sentinel_password is not None:
        text += f"?sentinel_password={quote(sentinel_password, safe='')}"
        address = replace(address, sentinel_password=sentinel_password)
    assert parse_address(text) == address


@given(st.text())
def test_any_text_is_an_address_or_a_plain_refusal(text: str) -> None:
    for prefix in ("", "redis://", "redis+sentinel://", "rediss+cluster://"):
        try:
            parse_address(prefix + text)
        except ValueError as error:
            assert type(error) is ValueError  # noqa: PT017 - it may pass as well


@pytest.mark.parametrize(
    "text",
    [
        "redis://user:hush@cache/3",
        "redis+sentinel://:hush@a,b/tracks?sentinel_username=u&sentinel_password=hush",
        "rediss+cluster://user:hush@a",
    ],
)
def test_passwords_are_not_told(text: str) -> None:
    address = parse_address(text)
    assert address.password == "hush"
    assert "hush" not in f"{address} {address!r}"


@pytest.mark.parametrize(
    "text",
    [
        "redis://hush@cache",
        "redis://user:hush",
        "redis://user:hush/@cache",
        "redis://user:hu%sh@cache",
        "redis://user:hush %FF@cache",
        "redis://user:hush%FF@cache",
        "redis://user:hush?@cache",
        "redis://user:hush#@cache",
        "hush://user:hush@cache",
        "redis+sentinel://a/tracks?sentinel_pasword=hush",
        "redis+cluster://a/hush",
    ],
)
def test_refusals_do_not_tell_what_was_given(text: str) -> None:
    with pytest.raises(ValueError, match=r"[Rr]edis") as refused:
        parse_address(text)
    assert "hu" not in str(refused.value)
    assert refused.value.__cause__ is None
    assert refused.value.__suppress_context__ or refused.value.__context__ is None
