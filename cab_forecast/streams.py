"""Streamed responses: iterators over the messages of a call, which end the call when they are closed."""

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
    """Messages of a started call, as they arrive.

    The stream ends when the server ends it. Otherwise close it (``with`` does), or it stays open as long as
    the client.
    """

    def __init__(self, messages: Iterator[_Message], cancel: Callable[[], None]) -> None:
        """Create a stream of a started call.

        Args:
            messages: blocks until the next message; raises ForecastError if the call fails.
            cancel: ends the call; may be called from any thread and repeatedly.
        """
        self._messages = messages
        self._cancel = cancel
        self._closed = False

    def __next__(self) -> _Message:
        """Return the next message.

        Raises:
            ForecastError: the call failed; the subclass says why.
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
        """End the call. In another thread that waits for a message, the iteration ends."""
        self._closed = True
        self._cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class OpenStream(Generic[_Message]):
    """A started call of an asyncio transport."""

    messages: AsyncGenerator[_Message]
    """Waits for the next message; raises ForecastError if the call fails."""
    cancel: Callable[[], Awaitable[object]]
    """Ends the call; may be called repeatedly."""


class AsyncStream(Generic[_Message]):
    """``Stream`` for asyncio.

    The call starts with ``async with`` or with the first message. It ends, too, if the task that waits for a
    message is cancelled.
    """

    def __init__(self, start: Callable[[], Awaitable[OpenStream[_Message]]]) -> None:
        """Create a stream; its call is not started yet.

        Args:
            start: starts the call; raises ForecastError if that fails.
        """
        self._start = start
        self._opened: OpenStream[_Message] | None = None
        self._closed = False

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> _Message:
        """Return the next message.

        Raises:
            ForecastError: the call failed; the subclass says why.
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
            # gRPC also raises this when its call was ended, by this stream or with the client.
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
        """End the call. In another task that waits for a message, the iteration ends."""
        self._closed = True
        opened, self._opened = self._opened, None
        if opened is not None:
            await opened.cancel()
            with suppress(RuntimeError):  # another task is inside the generator, and will end it
                await opened.messages.aclose()

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.aclose()

    async def _open(self) -> OpenStream[_Message]:
        if self._opened is None:
            opened = await self._start()
            if self._closed:  # by another task in the meantime
                await opened.cancel()
                raise StopAsyncIteration
            self._opened = opened
        return self._opened


def _is_cancelled() -> bool:
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
