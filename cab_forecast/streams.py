"""Answers that go on: iterators that end their call when they are closed."""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Self, TypeVar

from google.protobuf.message import Message

from cab_forecast.errors import Unavailable

_Message = TypeVar("_Message", bound=Message)


class Stream(Iterator[_Message]):
    """The messages of a call that has begun, as they come. Ends when the server ends it; close it (``with``
    does), or it goes on for as long as the client is open."""

    def __init__(self, messages: Iterator[_Message], hang_up: Callable[[], None]) -> None:
        """
        Args:
            messages: waits for the next one; raises ForecastError where there is none.
            hang_up: ends the call; from any thread, any number of times.
        """
        self._messages = messages
        self._hang_up = hang_up
        self._closed = False

    def __next__(self) -> _Message:
        """The next message.

        Raises:
            ForecastError: the call failed; its subclass says why.
        """
        if self._closed:
            raise StopIteration
        try:
            return next(self._messages)
        except StopIteration:
            self.close()
            raise
        except Exception:
            if self._closed:  # by another thread, while this one waited
                raise StopIteration from None
            self.close()
            raise

    def close(self) -> None:
        """Ends the call; another thread that waits for the next message finds the end."""
        self._closed = True
        self._hang_up()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class Opened(Generic[_Message]):
    """A call that has begun."""

    messages: AsyncGenerator[_Message]
    """Waits for the next one; raises ForecastError where there is none."""
    hang_up: Callable[[], Awaitable[object]]
    """Ends the call, any number of times."""


class AsyncStream(Generic[_Message]):
    """``Stream`` for asyncio. The call begins with ``async with``, or with the first message asked for; it
    ends with a task that is cancelled while it waits for a message."""

    def __init__(self, begin: Callable[[], Awaitable[Opened[_Message]]]) -> None:
        """
        Args:
            begin: the call; raises ForecastError where it does not.
        """
        self._begin = begin
        self._opened: Opened[_Message] | None = None
        self._closed = False

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> _Message:
        """The next message.

        Raises:
            ForecastError: the call failed; its subclass says why.
        """
        if self._closed:
            raise StopAsyncIteration
        try:
            opened = await self._open()
            return await anext(opened.messages)
        except StopAsyncIteration:
            await self.aclose()
            raise
        except asyncio.CancelledError:
            closed = self._closed
            await self.aclose()
            # gRPC raises it where its call was ended, too: by us, or with the client
            if _is_cancelled():
                raise
            if closed:
                raise StopAsyncIteration from None
            raise Unavailable("the client was closed") from None
        except Exception:
            if self._closed:  # by another task, while this one waited
                raise StopAsyncIteration from None
            await self.aclose()
            raise

    async def aclose(self) -> None:
        """Ends the call; another task that waits for the next message finds the end."""
        self._closed = True
        opened, self._opened = self._opened, None
        if opened is not None:
            await opened.hang_up()
            with suppress(RuntimeError):  # another task is still in it, and finds the end by itself
                await opened.messages.aclose()

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.aclose()

    async def _open(self) -> Opened[_Message]:
        if self._opened is None:
            opened = await self._begin()
            if self._closed:  # by another task meanwhile
                await opened.hang_up()
                raise StopAsyncIteration
            self._opened = opened
        return self._opened


def _is_cancelled() -> bool:
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
