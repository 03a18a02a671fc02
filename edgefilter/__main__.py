"""Where the program begins, before anything else is imported: to load it takes a while, in which somebody may press Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys


def main() -> int:
    """The command line with an answer to SIGINT and SIGTERM from the first moment on; its own take their place for a command."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from edgefilter.cli import main

    return main()


def _leave(*_: object) -> None:
    """End at once: an exception in the midst of an import may be swallowed, or told by a traceback."""
    os.write(2, b"edgefilter: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
