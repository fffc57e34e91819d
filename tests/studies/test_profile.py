"""What is read from a profile of a GPU."""

from mjx_drax.studies.profile import busy, waits


def event(name, start, end):
    return {"name": name, "ts": start, "dur": end - start}


EVENTS = [event("c", 9.0, 10.0), event("a", 1.0, 4.0), event("b", 2.0, 3.0), event("b", 5.0, 6.0)]


def test_a_gpu_is_busy_while_any_kernel_runs():
    assert busy(EVENTS) == 5.0


def test_it_waits_from_the_last_end_to_the_next_start():
    assert waits(EVENTS) == {"a to b": [1.0], "b to c": [3.0]}
