"""One pool of threads for every kernel.

numba's `prange` keeps a work queue of its own that is not safe inside a host process which also
runs threads (Blender), so kernels are plain `nogil` functions over an index range, and the ranges
are handed out here.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import itertools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

from ...cores import threads

_pool: ThreadPoolExecutor | None = None
_pool_size = 0
_here = threading.local()
_ran: set[Any] = set()  # what has run before
_first = threading.RLock()


@contextlib.contextmanager
def torch_alone() -> Iterator[None]:
    """torch on one thread inside the block; our own pool has the others.

    Between our kernels torch does many small things, for which its threads wait on each other: on a
    busy machine that made an iteration ten times slower.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _executor(size: int) -> ThreadPoolExecutor:
    global _pool, _pool_size
    if _pool is None or _pool_size < size:
        _pool = ThreadPoolExecutor(size, thread_name_prefix="pav")
        _pool_size = size
    return _pool


def _forget_pool() -> None:
    """A forked child has no worker threads: it must start its own. Nor can it wait for a lock that
    a thread held which it does not have."""
    global _pool, _pool_size, _first
    _pool, _pool_size, _first = None, 0, threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


@contextlib.contextmanager
def _busy() -> Iterator[None]:
    before = getattr(_here, "busy", False)
    _here.busy = True
    try:
        yield
    finally:
        _here.busy = before


def _bounds(n: int, chunk: int, least: int | None) -> list[int]:
    """Where pieces begin, and n: of `chunk` each; or of at most that, and the smaller the less is
    left, down to `least`."""
    if least is None:
        return [*range(0, n, chunk), n]
    found = [0]
    while found[-1] < n:
        share = -(-(n - found[-1]) // (2 * threads()))
        found.append(min(n, found[-1] + min(chunk, max(least, share))))
    return found


def run_chunks(
    fn: Callable[..., Any], n: int, chunk: int, *args: Any, least: int | None = None
) -> None:
    """Call `fn(start, stop, *args)` over [0, n) in pieces of `chunk`, on all threads at once; with
    `least`, in pieces that shrink down to it, so that all threads end together.

    Pieces go to whichever thread is free, the caller's included, so uneven work balances itself;
    which thread runs which piece is not fixed, so pieces must not depend on one another. The first
    exception is raised here after the others have stopped. A call from within a piece runs in that
    piece's thread alone: the others have pieces of their own. The very first piece of a function
    runs before all others: numba aborts the process where two threads bring it the same new type.
    """
    if chunk < 1:
        raise ValueError(f"chunk must be at least 1, not {chunk}")
    bounds = _bounds(n, chunk, least)
    pieces = len(bounds) - 1
    workers = 1 if getattr(_here, "busy", False) else min(threads(), pieces)
    code = getattr(inspect.unwrap(fn), "__code__", fn)
    ahead = 0
    if code not in _ran and pieces:
        with _first, _busy():
            fn(0, bounds[1], *args)
        _ran.add(code)
        ahead = 1
    if workers <= 1:
        for piece in range(ahead, pieces):
            fn(bounds[piece], bounds[piece + 1], *args)
        return
    counter = itertools.count(ahead)

    def work() -> None:
        try:
            with _busy():
                for piece in counter:
                    if piece >= pieces:
                        return
                    fn(bounds[piece], bounds[piece + 1], *args)
        except BaseException:
            for _ in range(pieces):  # nothing is left for the others
                if next(counter) >= pieces:
                    break
            raise

    helpers = [_executor(workers - 1).submit(work) for _ in range(workers - 1)]
    try:
        work()
    finally:
        # A helper that never started (a nested call on a full pool) has nothing left to do.
        running = [helper for helper in helpers if not helper.cancel()]
        failures = [error for error in (helper.exception() for helper in running) if error]
    if failures:
        raise failures[0]


def each(fn: Callable[[int], Any], n: int) -> list[Any]:
    """`[fn(0), ..., fn(n - 1)]`, made by all threads at once; see `run_chunks`."""
    found: list[Any] = [None] * n

    @functools.wraps(fn)  # the first call of `fn` goes before all others, not that of `make`
    def make(start: int, stop: int) -> None:
        for index in range(start, stop):
            found[index] = fn(index)

    run_chunks(make, n, 1)
    return found
