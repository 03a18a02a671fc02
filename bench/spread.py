"""Independent tasks over the cores of this machine, or over those of a Dask cluster whose machines see the same files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from typing import Any, TypeVar

from edgefilter.errors import UsageError

Task = TypeVar("Task")
Result = TypeVar("Result")
PATIENCE = "10s"
AHEAD = 4
"""Tasks a worker of the cluster has waiting: enough that it never waits itself, few enough to stop soon."""

_shared: list[Any] = []


def spread(
    function: Callable[[Any, Task], Result], shared: Any, tasks: Sequence[Task], jobs: int, scheduler: str | None = None
) -> Iterator[Result]:
    """function(shared, task) of every task, in any order, as each is done; what is under way ends with the iterator.

    shared goes to every worker once. scheduler: address of a Dask scheduler, in place of `jobs` processes here. Raises
    UsageError where nothing answers there.
    """
    return _over_cluster(function, shared, tasks, scheduler) if scheduler else _here(function, shared, tasks, jobs)


def _here(function: Callable[[Any, Task], Result], shared: Any, tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    pool = ProcessPoolExecutor(jobs, initializer=_keep, initargs=(shared,))
    try:
        yield from pool.map(_call, [(function, task) for task in tasks])
    finally:
        pool.shutdown(cancel_futures=True)


def _keep(shared: Any) -> None:
    _shared[:] = [shared]


def _call(job: tuple[Callable[[Any, Task], Result], Task]) -> Result:
    function, task = job
    return function(_shared[0], task)


def _over_cluster(
    function: Callable[[Any, Task], Result], shared: Any, tasks: Sequence[Task], scheduler: str
) -> Iterator[Result]:
    from distributed import Client, as_completed

    try:
        client = Client(scheduler, timeout=PATIENCE)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"no Dask scheduler answers at {scheduler} ({error}): start one with 'dask scheduler'"
        ) from None
    with client:
        everywhere, waiting = client.scatter(shared, broadcast=True), iter(tasks)
        count = AHEAD * max(1, sum(client.nthreads().values()))
        first = [client.submit(function, everywhere, task, pure=False) for task in islice(waiting, count)]
        running = as_completed(first)
        for done in running:
            if (task := next(waiting, None)) is not None:
                running.add(client.submit(function, everywhere, task, pure=False))
            yield done.result()
