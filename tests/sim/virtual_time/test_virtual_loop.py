"""The virtual clock: time jumps, order is fixed, nothing hangs and nothing is swallowed."""

import asyncio
import threading
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.virtual_time.loop import LoopScheduler, VirtualDeadlock, VirtualLoop


def run(coroutine: Any) -> Any:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(coroutine)


def loop() -> VirtualLoop:
    found = asyncio.get_running_loop()
    assert isinstance(found, VirtualLoop)
    return found


def test_an_hour_passes_without_waiting() -> None:
    async def main() -> tuple[float, int]:
        assert loop().time() == 0.0
        await asyncio.sleep(3600.0)
        return loop().time(), loop().now_ns

    assert run(main()) == (3600.0, 3_600_000_000_000)


@settings(deadline=None)
@given(st.lists(st.integers(0, 20), max_size=40))
def test_events_run_in_the_order_of_time_and_ties_in_that_of_scheduling(due_ns) -> None:
    ran: list[tuple[int, int]] = []

    async def main() -> None:
        for number, due in enumerate(due_ns):
            loop().schedule_ns(due, lambda number=number: ran.append((loop().now_ns, number)))
        await asyncio.sleep(1e-6)

    run(main())
    assert ran == sorted((due, number) for number, due in enumerate(due_ns))


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 10.0), max_size=20))
def test_timers_of_asyncio_and_plain_calls_share_one_order(delays_s) -> None:
    ran: list[int] = []

    async def main() -> None:
        for number, delay_s in enumerate(delays_s):
            if number % 2:
                loop().call_later(delay_s, ran.append, number)
            else:
                LoopScheduler(loop()).call_later(delay_s, lambda number=number: ran.append(number))
        await asyncio.sleep(11.0)

    run(main())
    assert ran == sorted(range(len(delays_s)), key=lambda number: (round(delays_s[number] * 1e9), number))


def test_time_stands_still_while_anything_is_ready() -> None:
    async def main() -> list[float]:
        seen = []
        loop().call_later(1e-9, seen.append, -1.0)
        for _ in range(100):
            await asyncio.sleep(0)
            seen.append(loop().time())
        return seen

    assert run(main()) == [0.0] * 100


def test_a_1_khz_loop_does_not_drift_by_a_nanosecond() -> None:
    async def main() -> int:
        done = loop().create_future()

        def tick(number: int) -> None:
            assert loop().now_ns == number * 1_000_000
            if number == 20_000:
                done.set_result(number)
            else:
                loop().call_at((number + 1) / 1000, tick, number + 1)

        tick(0)
        return await done

    assert run(main()) == 20_000


def test_what_lies_in_the_past_runs_now() -> None:
    async def main() -> list[int]:
        await asyncio.sleep(1.0)
        seen: list[int] = []
        loop().call_at(0.5, lambda: seen.append(loop().now_ns))
        loop().schedule_ns(3, lambda: seen.append(loop().now_ns))
        await asyncio.sleep(1e-9)
        return seen

    assert run(main()) == [1_000_000_000, 1_000_000_000]


def test_waiting_for_nothing_is_an_error_that_names_who_waits() -> None:
    async def main() -> None:
        asyncio.current_task().set_name("the sequencer")  # type: ignore[union-attr]
        await asyncio.sleep(1.5)
        await asyncio.Event().wait()

    with pytest.raises(VirtualDeadlock, match=r"1\.500000000 s.*the sequencer"):
        run(main())


def test_time_outs_take_virtual_time() -> None:
    async def main() -> float:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.Event().wait(), 30.0)
        return loop().time()

    assert run(main()) == 30.0


def test_a_cancelled_timer_neither_runs_nor_stops_the_clock() -> None:
    async def main() -> float:
        loop().call_later(1.0, pytest.fail).cancel()
        await asyncio.sleep(2.0)
        handle = loop().call_later(100.0, pytest.fail)
        handle.cancel()
        handle.cancel()
        return loop().time()

    assert run(main()) == 2.0


def test_cancelled_timers_do_not_pile_up() -> None:
    async def main() -> int:
        async def soon() -> None:
            await asyncio.sleep(1e-6)

        for _ in range(5000):
            await asyncio.wait_for(soon(), 1e6)
        return len(loop()._heap)

    # Swept once more than half of the heap, and at least 256 timers, are cancelled.
    assert run(main()) < 600


def test_an_exception_in_a_callback_ends_the_run() -> None:
    def fail() -> None:
        raise ValueError("from a callback")

    async def by_timer() -> None:
        loop().call_later(1.0, fail)
        await asyncio.sleep(2.0)

    async def by_call_soon() -> None:
        loop().call_soon(fail)
        await asyncio.sleep(2.0)

    async def by_schedule() -> None:
        loop().schedule_ns(5, fail)
        await asyncio.sleep(2.0)

    for main in (by_timer, by_call_soon, by_schedule):
        with pytest.raises(ValueError, match="from a callback"):
            run(main())


def test_an_exception_in_a_task_reaches_who_awaits_it() -> None:
    async def fail() -> None:
        await asyncio.sleep(1.0)
        raise ValueError("from a task")

    async def main() -> None:
        with pytest.raises(ValueError, match="from a task"):
            await asyncio.create_task(fail())

    run(main())


def test_work_for_other_threads_runs_inline_in_no_time() -> None:
    async def main() -> tuple[int, float]:
        thread = await asyncio.to_thread(threading.get_ident)
        with pytest.raises(ZeroDivisionError):
            await loop().run_in_executor(None, lambda: 1 // 0)
        return thread, loop().time()

    assert run(main()) == (threading.get_ident(), 0.0)


def test_another_thread_may_not_reach_in() -> None:
    refused: list[str] = []

    async def main() -> None:
        found = loop()

        def intrude() -> None:
            try:
                found.call_soon_threadsafe(print)
            except RuntimeError as error:
                refused.append(str(error))

        intruder = threading.Thread(target=intrude)
        intruder.start()
        intruder.join()

    run(main())
    assert len(refused) == 1
    assert "single-threaded" in refused[0]


def test_a_closed_loop_takes_nothing() -> None:
    found = VirtualLoop()
    found.close()
    with pytest.raises(RuntimeError, match="closed"):
        found.schedule_ns(0, print)
    with pytest.raises(RuntimeError, match="closed"):
        found.call_later(1.0, print)


def test_queues_and_tasks_interleave_the_same_way_every_time() -> None:
    async def main() -> list[tuple[int, str]]:
        trace: list[tuple[int, str]] = []
        queue: asyncio.Queue[str] = asyncio.Queue(3)

        async def produce(name: str, period_s: float) -> None:
            for number in range(50):
                await asyncio.sleep(period_s)
                await queue.put(f"{name}{number}")

        async def consume() -> None:
            while True:
                trace.append((loop().now_ns, await queue.get()))
                await asyncio.sleep(0.0004)

        async with asyncio.TaskGroup() as group:
            consumer = group.create_task(consume())
            producers = [group.create_task(produce(n, p)) for n, p in (("a", 1e-3), ("b", 1e-3), ("c", 7e-4))]
            await asyncio.wait(producers)
            await asyncio.sleep(1.0)
            consumer.cancel()
        return trace

    first = run(main())
    assert len(first) == 150
    assert first == run(main())


def test_frozen_tasks_stand_still_while_the_world_goes_on_and_then_run_late_in_order() -> None:
    ran: list[tuple[str, int]] = []

    async def main() -> None:
        def note(name: str) -> None:
            ran.append((name, loop().now_ns))

        loop().schedule_ns(10, lambda: loop().freeze_tasks(100))
        for due_ns in (5, 50, 90, 200):
            loop().schedule_ns(due_ns, lambda due_ns=due_ns: note(f"world {due_ns}"))
        loop().call_later(60e-9, note, "timer 60")
        loop().call_later(40e-9, note, "timer 40")
        loop().schedule_ns(20, lambda: loop().call_soon(note, "soon"))
        await asyncio.sleep(150e-9)
        note("task")
        await asyncio.sleep(100e-9)

    run(main())
    assert ran == [
        *(("world 5", 5), ("world 50", 50), ("world 90", 90)),
        *(("soon", 110), ("timer 40", 110), ("timer 60", 110)),
        *(("task", 150), ("world 200", 200)),
    ]


def test_a_call_that_lets_time_pass_in_a_freeze_passes_no_more_than_there_is_of_it() -> None:
    free: list[int | None] = []

    async def main() -> None:
        loop().schedule_ns(10, lambda: loop().freeze_tasks(100))
        loop().schedule_ns(30, lambda: free.append(loop().free_ns))
        await asyncio.sleep(20e-9)

    run(main())
    assert free == [80]


def test_what_ends_a_freeze_early_loses_no_timer() -> None:
    async def main() -> None:
        def fail() -> None:
            raise ArithmeticError

        loop().schedule_ns(10, lambda: loop().freeze_tasks(100))
        loop().schedule_ns(50, fail)
        await asyncio.sleep(20e-9)

    frozen = VirtualLoop()
    task = frozen.create_task(main())
    with pytest.raises(ArithmeticError):
        frozen.run_until_complete(task)
    assert frozen.now_ns == 50
    frozen.run_until_complete(task)
    frozen.close()
