"""Where the program begins, before anything else is imported: to load it takes a while, in which somebody may press Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys


def main() -> int:
    """Run the command line; SIGINT and SIGTERM end it cleanly from the start, later each command sets handlers of its own."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    # before numpy is loaded: the filter and its learner have a core each, and on a busy machine threads of numpy's linear algebra
    # take more time to wait for one another than they save
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from edgefilter.cli import main

    return main()


def _leave(*_: object) -> None:
    """Exit at once: KeyboardInterrupt raised inside an import may be swallowed, or end in a traceback."""
    os.write(2, b"edgefilter: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
