"""When a worker looks for its next job."""

import threading

from workers.slots import Slots


def test_nothing_is_looked_for_while_every_slot_is_taken() -> None:
    slots, polls = Slots(2), threading.Semaphore(0)

    def poll() -> None:
        while not slots.wait(0.01):
            polls.release()

    thread = threading.Thread(target=poll)
    thread.start()
    with slots.taken():
        assert polls.acquire(timeout=10.0)
        with slots.taken():
            while polls.acquire(blocking=False):
                pass
            assert sum(polls.acquire(timeout=1.0) for _ in range(2)) <= 1  # one may have been on its way
        assert polls.acquire(timeout=10.0)
    slots.close()
    thread.join(10.0)
    assert not thread.is_alive()


def test_a_worker_whose_slots_are_taken_can_be_told_to_stop() -> None:
    slots, told = Slots(1), threading.Event()

    def wait() -> None:
        if slots.wait(0.01):
            told.set()

    thread = threading.Thread(target=wait)
    with slots.taken():
        thread.start()
        slots.close()
        assert told.wait(10.0)
    thread.join(10.0)
