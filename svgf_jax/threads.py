"""Reading ahead and writing behind: two small bounded queues over thread pools, or over one that they share."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def read_ahead(
    read: Callable[[Item], Result], items: Iterable[Item], *, threads: int, pool: Executor | None = None
) -> Generator[Result, None, None]:
    """`map(read, items)`, in order, with up to `threads` of them read before they are asked for.

    At most `threads + 1` results exist at a time. What `read` raises comes out where its result would have. Closing the
    iterator drops the reads that have not begun, and waits for the others unless they are in a `pool` of the caller.
    """
    with _workers(pool, threads, "svgf-read") as workers:
        pending: deque[Future[Result]] = deque()
        try:
            for item in items:
                pending.append(workers.submit(read, item))
                if len(pending) > threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


class Submit(Protocol):
    """Hand a job to the background; `after_all`: it starts once every earlier one has succeeded."""

    def __call__(self, job: Callable[[], Any], /, *, after_all: bool = False) -> None: ...  # noqa: D102


@contextmanager
def write_behind(done: Callable[[Any], None], *, threads: int, pool: Executor | None = None) -> Generator[Submit]:
    """A function that runs jobs in the background, and waits while more than `threads` of them are unfinished.

    Results reach `done` in the order of submission, in the caller's thread. A job's exception is raised by a later
    submission or at the end of the `with` block. Whatever ends the block, jobs already submitted are completed.
    """
    pending: deque[Future[Any]] = deque()

    def submit(job: Callable[[], Any], /, *, after_all: bool = False) -> None:
        while len(pending) > threads:
            done(pending.popleft().result())
        # Jobs start in order, so whatever this one waits for has started already: no deadlock, even with one thread.
        pending.append(workers.submit(_after, list(pending), job) if after_all else workers.submit(job))

    with _workers(pool, threads, "svgf-write") as workers:
        try:
            yield submit
        except BaseException:
            for future in pending:
                with suppress(Exception):  # what ended the block is told, not what comes of it
                    done(future.result())
            raise
        while pending:
            done(pending.popleft().result())


def _workers(pool: Executor | None, threads: int, name: str) -> AbstractContextManager[Executor]:
    return ThreadPoolExecutor(threads, thread_name_prefix=name) if pool is None else nullcontext(pool)


def _after(earlier: list[Future[Any]], job: Callable[[], Any]) -> Any:
    for future in earlier:
        future.result()
    return job()
