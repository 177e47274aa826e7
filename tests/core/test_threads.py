"""The pool: every piece once, pieces within pieces on one thread, the first error out."""

from __future__ import annotations

import threading
import time

import pytest

from pav_blender.core.kernels.cpu.threads import each, run_chunks


@pytest.fixture(autouse=True)
def three_threads(monkeypatch):
    monkeypatch.setenv("PAV_THREADS", "3")


def test_every_index_is_in_one_piece():
    seen = [0] * 1000

    def count(start: int, stop: int) -> None:
        for i in range(start, stop):
            seen[i] += 1

    run_chunks(count, 1000, 7)
    assert seen == [1] * 1000


def test_pieces_shrink_and_every_index_is_in_one():
    pieces = []
    run_chunks(lambda start, stop: pieces.append((start, stop)), 1000, 100, least=7)
    pieces.sort()
    assert [start for start, _ in pieces] == [0, *(stop for _, stop in pieces[:-1])]
    assert pieces[-1][1] == 1000
    sizes = [stop - start for start, stop in pieces]
    assert sizes[:-1] == sorted(sizes[:-1], reverse=True)
    assert sizes[0] == 100
    assert min(sizes[:-1]) == 7


def test_a_call_within_a_piece_stays_on_its_thread():
    alone = []

    def piece(start: int, stop: int) -> None:
        inner = set()
        run_chunks(lambda a, b: inner.add(threading.get_ident()), 50, 1)
        alone.append(inner == {threading.get_ident()})

    run_chunks(piece, 12, 1)
    assert alone == [True] * 12


def test_the_first_error_comes_out_and_the_pool_goes_on():
    def fail(start: int, stop: int) -> None:
        raise ValueError(f"piece {start}")

    with pytest.raises(ValueError, match="piece"):
        run_chunks(fail, 100, 1)
    threads, barrier = set(), threading.Barrier(2, timeout=10)

    def meet(start: int, stop: int) -> None:
        if start == 0:  # before all others
            assert not threads
            return
        threads.add(threading.get_ident())
        barrier.wait()  # passes only if two threads are at work

    run_chunks(meet, 3, 1)
    assert len(threads) == 2


def test_each_keeps_the_order_and_makes_the_first_alone():
    """Also of what is first called within: numba aborts where two threads bring a new type."""
    inside, most = 0, []
    lock = threading.Lock()

    def inner(start: int, stop: int) -> None:
        nonlocal inside
        with lock:
            inside += 1
            most.append(inside)
        time.sleep(0.01)
        with lock:
            inside -= 1

    met = threading.Barrier(2, timeout=10)

    def outer(index: int) -> int:
        if index in (1, 2):
            met.wait()  # these two are at work at once, and both call what nobody has called
            run_chunks(inner, 1, 1)
        return index * index

    assert each(outer, 6) == [0, 1, 4, 9, 16, 25]
    assert most == [1, 1]
    assert each(outer, 0) == []
