"""What services that listen on a port share: telling local addresses from others, and one line for an error of asyncio."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from typing import Any

from edgefilter.errors import printable

_LOGGER = logging.getLogger(__name__)
_SAID_AGAIN_S = 60.0
"""For how long the same complaint is not said again: without descriptors each new client would be one a second."""


def is_own(host: str) -> bool:
    """Whether only this machine reaches it.

    >>> is_own("localhost"), is_own("127.0.0.1"), is_own("0.0.0.0")
    (True, True, False)
    """
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def complain_briefly() -> None:
    """Have the running event loop say in one line what it cannot do, such as to take one more client, and not again at once."""
    said: dict[str, float] = {}

    def complain(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        what, error = context["message"], context.get("exception")
        if loop.time() < said.get(what, 0.0):
            return
        said[what] = loop.time() + _SAID_AGAIN_S
        _LOGGER.error("%s", printable(f"{what} ({type(error).__name__}: {error})"))

    asyncio.get_running_loop().set_exception_handler(complain)


def in_one_line(record: logging.LogRecord) -> bool:
    """Shorten what a library logs of a client to one line that only prints, without its traceback: a filter of its logger."""
    error = record.exc_info[1] if record.exc_info else None
    why = f" ({type(error).__name__}: {error})" if error else ""
    who = getattr(getattr(record, "websocket", None), "remote_address", None)
    record.msg, record.args = "%s", (printable(f"client {who}: {record.getMessage()}{why}"),)
    record.exc_info = record.exc_text = None
    return True
