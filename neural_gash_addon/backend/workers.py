# SPDX-License-Identifier: GPL-3.0-or-later
"""Work spread over threads, whose results come as they are done, and products that do not disturb them."""
from __future__ import annotations

import os
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Result = TypeVar("Result")

BLAS_SERIAL = 1 << 18  # multiply-adds up to which OpenBLAS stays on the calling thread
# Rays, times threads, up to which there are none: waking them takes 50 µs and more each time, and on two threads of one
# core nothing is gained by them in 20 ms. Many cores are awaited less long.
_FEW_RAYS = 1 << 17


def default_threads() -> int:
    """One worker a core this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Here(Executor):
    """Does everything at once, on the thread that asks for it."""

    def submit(self, fn: Callable[..., Result], /, *arguments: object, **named: object) -> Future[Result]:
        """The future of a call that is over."""
        future: Future[Result] = Future()
        try:
            future.set_result(fn(*arguments, **named))
        except Exception as error:  # noqa: BLE001  raised where it is awaited, as of any executor
            future.set_exception(error)
        return future


def workers(threads: int, rays: float = float("inf")) -> Executor:
    """Threads for so many rays, or what takes as long; the calling one where few would only wait for each other."""
    if working(threads, rays) == 1:
        return _Here()
    return ThreadPoolExecutor(threads, thread_name_prefix="neural_gash")


def working(threads: int, rays: float) -> int:
    """Among how many threads `workers` spreads so many rays."""
    return 1 if rays * threads <= _FEW_RAYS else threads


def results(pool: Executor, threads: int, jobs: Iterable[tuple], work: Callable[..., Result]
            ) -> Generator[Result, None, None]:
    """`work(*job)` of each job, in the order in which they end; two jobs wait for each of the threads.

    Closing the generator, or an error, leaves the jobs undone that have not begun. An error is raised here.
    """
    # not concurrent.futures.wait: Ctrl-C inside it leaves the futures' locks taken, and the workers stuck
    finished: SimpleQueue[tuple[Result | None, Exception | None]] = SimpleQueue()
    stop = threading.Event()

    def run(job: tuple) -> None:
        try:
            finished.put((None if stop.is_set() else work(*job), None))
        except Exception as error:  # noqa: BLE001  raised again where it is awaited
            finished.put((None, error))

    remaining = iter(jobs)
    waiting = 0
    try:
        while True:
            while waiting < 2 * threads and (job := next(remaining, None)) is not None:
                pool.submit(run, job)
                waiting += 1
            if not waiting:
                return
            found, error = finished.get()
            waiting -= 1
            if error is not None:
                raise error
            yield found  # type: ignore[misc]  # None comes only after the end
    finally:
        stop.set()


def product(a: NDArray, b: NDArray) -> NDArray:
    """a (n, p) @ b (p, q) in pieces too small for BLAS to spread over threads of its own.

    The workers already use every core; BLAS's threads would only wait for each other, and spin for a while after.
    """
    (count, inner), outer = a.shape, b.shape[1]
    rows = max(1, BLAS_SERIAL // (inner * outer))
    whole = count - count % rows
    out = np.empty((count, outer), a.dtype)
    np.matmul(a[:whole].reshape(-1, rows, inner), b, out=out[:whole].reshape(-1, rows, outer))
    np.matmul(a[whole:], b, out=out[whole:])
    return out
