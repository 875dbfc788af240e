# SPDX-License-Identifier: MIT
"""Work in pieces: in this process, in several here, or on a Dask cluster, with the same results in the
same order."""

import collections
import time
from concurrent import futures
from typing import Any, Callable, Deque, Iterator, NamedTuple, Optional, Sequence, TypeVar

from semantic_lidar_fusion import cli
from semantic_lidar_fusion.errors import DataError

# What does not answer for so long is lost (s).
DASK_PATIENCE_S = 5.0
# Between two questions whether it is there (s).
_DASK_PERIOD_S = 0.5

Item = TypeVar("Item")
Result = TypeVar("Result")


class Work(NamedTuple):
    """How to compute: workers > 1 are processes on this machine; scheduler is a Dask address."""

    workers: int = 1
    scheduler: Optional[str] = None


def in_order(
    items: Sequence[Item], compute: Callable[[Item], Result], work: Work
) -> Iterator[Result]:
    """compute(item) of each item, in their order; `compute` is a function of a module, and items and
    results can be pickled. DataError if workers or cluster are lost."""
    if work.scheduler is not None:
        return _dask_results(items, compute, work.scheduler)
    if work.workers > 1:
        return _process_results(items, compute, work.workers)
    return (compute(item) for item in items)


def _in_order(
    items: Sequence[Item],
    limit: int,
    submit: Callable[[Item], Any],
    wait: Callable[[Any], Result],
    cancel: Callable[[Any], Any],
) -> Iterator[Result]:
    """Results in the order of the items, with at most `limit` on their way: finished ones hold
    memory. What is on its way at an early end is cancelled."""
    remaining: Deque[Item] = collections.deque(items)
    flying: Deque[Any] = collections.deque()
    try:
        while remaining or flying:
            while remaining and len(flying) < limit:
                flying.append(submit(remaining.popleft()))
            yield wait(flying[0])
            flying.popleft()
    finally:
        for future in flying:
            cancel(future)


def _process_results(
    items: Sequence[Item], compute: Callable[[Item], Result], workers: int
) -> Iterator[Result]:
    with futures.ProcessPoolExecutor(max_workers=workers) as pool:
        try:
            yield from _in_order(
                items,
                2 * workers,
                lambda item: pool.submit(compute, item),
                lambda future: future.result(),
                lambda future: future.cancel(),
            )
        except futures.process.BrokenProcessPool as error:
            raise DataError("a worker process died (out of memory?)") from error


def _dask_results(
    items: Sequence[Item], compute: Callable[[Item], Result], scheduler: str
) -> Iterator[Result]:
    cli.require("distributed")
    import logging

    import distributed

    # Their own complaints, a page each, come before the line that says what it means.
    for name in ("distributed", "distributed.client", "tornado", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        # As the default client it would be closed again, and waited for, when Python ends.
        client = distributed.Client(scheduler, timeout=DASK_PATIENCE_S, set_as_default=False)
    except Exception as error:  # whatever an address may be wrong in
        raise DataError("no Dask scheduler at %s (%s)" % (scheduler, error)) from error
    try:
        try:
            client.wait_for_workers(1, timeout=DASK_PATIENCE_S)
            workers = _dask_workers(client)
        except Exception as error:
            raise DataError("the Dask scheduler at %s has no workers" % scheduler) from error
        yield from _in_order(
            items,
            2 * max(1, workers),
            lambda item: client.submit(compute, item, pure=False),
            lambda future: _dask_wait(client, future, scheduler),
            lambda future: None,  # the scheduler forgets what it does for a client that leaves
        )
    finally:
        try:
            client.close(timeout=1)
        except Exception:
            pass  # a scheduler that is gone cannot be told


def _dask_workers(client: Any) -> int:
    """The number of workers; raises where the scheduler does not answer in time."""
    answer = client.sync(client.scheduler.identity, callback_timeout=DASK_PATIENCE_S)
    return len(answer["workers"])


def _dask_wait(client: Any, future: Any, scheduler: str) -> Any:
    """The result of a future; DataError if its cluster is lost."""
    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker

    good_at = asked_at = time.monotonic()
    while not future.done():
        time.sleep(0.02)
        if time.monotonic() - asked_at < _DASK_PERIOD_S:
            continue
        try:
            workers, lost = (
                _dask_workers(client),
                "all workers of the Dask scheduler at %s are gone",
            )
        except Exception:  # whatever a connection may die of
            workers, lost = 0, "the Dask scheduler at %s is gone"
        asked_at = time.monotonic()
        if workers:
            good_at = asked_at
        elif asked_at - good_at > DASK_PATIENCE_S:
            raise DataError(lost % scheduler)
    try:
        return future.result(timeout=DASK_PATIENCE_S)
    except ImportError as error:
        raise DataError(
            "a Dask worker cannot import the package (%s); start the workers with its setup.bash "
            "sourced" % error
        ) from error
    except KilledWorker as error:
        raise DataError("Dask workers died again and again (out of memory?)") from error
    except (futures.CancelledError, CommClosedError, TimeoutError, OSError) as error:
        raise DataError("the Dask scheduler at %s is gone (%s)" % (scheduler, type(error).__name__)) from error  # fmt: skip
