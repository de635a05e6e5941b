import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from svgf_jax.threads import read_ahead, write_behind


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_reads_come_in_order_and_bounded(threads):
    begun = []

    def read(i):
        begun.append(i)
        time.sleep(0.002 * (i % 3))
        return i * i

    got = []
    for value in read_ahead(read, range(20), threads=threads):
        got.append(value)
        assert len(begun) <= len(got) + threads
    assert got == [i * i for i in range(20)]


def test_a_read_error_comes_in_its_place():
    def read(i):
        if i == 3:
            raise OSError("third")
        return i

    reading = read_ahead(read, range(10), threads=2)
    assert [next(reading) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(OSError, match="third"):
        next(reading)


def test_closing_stops_reading():
    begun = []
    reading = read_ahead(begun.append, range(1000), threads=2)
    next(reading)
    reading.close()
    count = len(begun)
    time.sleep(0.02)
    assert len(begun) == count < 10


def test_one_pool_reads_and_writes_in_the_order_asked_for():
    done = []
    with ThreadPoolExecutor(1) as pool, write_behind(lambda _: None, threads=1, pool=pool) as submit:
        for i in read_ahead(lambda i: (done.append(f"read {i}"), i)[1], range(4), threads=1, pool=pool):
            submit(lambda i=i: done.append(f"write {i}"))
    assert done[:6] == ["read 0", "read 1", "write 0", "read 2", "write 1", "read 3"]


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_order_in_the_callers_thread(threads):
    got = []
    with write_behind(lambda x: got.append((x, threading.get_ident())), threads=threads) as submit:
        for i in range(12):
            submit(lambda i=i: (time.sleep(0.002 * (i % 3)), i)[1])
    assert got == [(i, threading.get_ident()) for i in range(12)]


def test_a_job_after_all_others_sees_them_complete():
    complete, seen = [], []
    with write_behind(lambda _: None, threads=3) as submit:
        for i in range(3):
            submit(lambda i=i: (time.sleep(0.02), complete.append(i)))
        submit(lambda: seen.extend(complete), after_all=True)
    assert sorted(seen) == [0, 1, 2]


def test_a_failed_job_is_raised_and_stops_what_depends_on_it():
    ran = []

    def fail():
        raise OSError("disk full")

    def work():
        with write_behind(lambda _: None, threads=2) as submit:
            submit(fail)
            submit(lambda: ran.append("checkpoint"), after_all=True)
            submit(lambda: ran.append("independent"))

    with pytest.raises(OSError, match="disk full"):
        work()
    assert ran == ["independent"]


def test_jobs_submitted_before_an_error_are_completed_and_told():
    got = []

    def work():
        with write_behind(got.append, threads=2) as submit:
            for i in range(2):
                submit(lambda i=i: (time.sleep(0.02), i)[1])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert got == [0, 1]
