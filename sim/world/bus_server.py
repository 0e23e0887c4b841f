"""The world's end of the physics bus: steps the world in lock-step with the agents that are attached.

An agent is in the barrier while it answers every tick within the bound. One that does not (frozen, or just
starting) is excluded: its motors get zero PWM, and it receives no samples until it answers the frame that it
owes. That answer is late and so discarded, and the agent is back in the barrier with the next samples: a
thawed agent finds no backlog. A connection without a hello within `HELLO_S` is dropped, and an agent that has
not answered for `ABANDONED_S` loses its modules to the next one that asks for them. An agent that answers,
but keeps the world waiting, is named, once.
Agents that answer as they should are served by compiled calls, see `barrier`; all else is here.
"""

import os
import select
import socket
import stat
import struct
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, Self

import numpy as np

from module_agent.hardware.bus_frames import (
    MAX_HANDSHAKE_BYTES,
    FrameError,
    TickFrames,
    Welcome,
    pack_refusal,
    pack_welcome,
    unpack_hello,
)
from module_agent.hardware.hardware import Readings, WiredModule
from module_agent.hardware.packet_kernel import Words, work_space
from module_agent.model.errors import UsageError
from sim.world.barrier import SLIPPED, Barrier, keep_pace, new_pace, rehearse
from sim.world.truth import TruthLog

_BACKLOG = 128
_MAX_LAG_S = 0.020
# New connections are looked for after so many ticks of a world that runs them by itself.
_MANY_TICKS = 8
# A hello is sent at once; the rest is the patience of a busy machine.
HELLO_S = 2.0
# An agent may be frozen for a while and come back; it keeps its modules for this long.
ABANDONED_S = 10.0
# An agent is slow if the world waits this long for it in a tenth of its ticks.
SLOW_S = 0.005
SLOW_TICKS = 100
_WINDOW_TICKS = 10 * SLOW_TICKS


class World(Protocol):
    """A world that is stepped with one PWM per module, as the bus serves it."""

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The modules, in the order of `exchange`."""
        ...

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Advance by one tick and return one sample per module."""
        ...


class BusInUse(UsageError):
    """Another world listens on the path."""


class RunReport(NamedTuple):
    """What `BusServer.run` did: `slipped_s` of real time were given up because ticks took too long."""

    ticks: int
    simulated_s: float
    elapsed_s: float
    slipped_s: float
    achieved_speed: float


class _Agent:
    """An accepted connection; `slots` are its modules' places in the world, empty before its hello."""

    def __init__(self, connection: socket.socket):
        self.connection = connection
        # When it connected, said its hello, or was excluded.
        self.silent_since_s = time.monotonic()
        self.late_ticks = 0
        self.named = False
        self.serials: tuple[str, ...] = ()
        self.slots: tuple[int, ...] = ()
        self.frames = TickFrames.of(0)

    @property
    def name(self) -> str:
        return ", ".join(self.serials) or "an agent before its hello"

    def hung_up(self) -> bool:
        poll = select.poll()
        poll.register(self.connection, 0)
        return bool(poll.poll(0))


class BusServer:
    """Listens on a Unix SEQPACKET socket and steps `world` with what the attached agents answer.

    Args:
        path: of the socket; a stale file there is replaced, and it is removed by `close`.
        world: what is stepped.
        bound_s: how long one barrier waits for all its agents together.
        report: called with one line whenever an agent comes, goes, freezes or thaws.

    Raises:
        BusInUse: another world listens on the path.
        UsageError: the path cannot be bound; a file that is no socket is left alone.
    """

    def __init__(
        self, path: str, world: World, bound_s: float = 0.05, report: Callable[[str], None] | None = None
    ):
        self._path = path
        self._world = world
        self._bound_s = bound_s
        self._report = report or (lambda line: None)
        self._slot_of = {module.serial: slot for slot, module in enumerate(world.modules)}
        self._pwm = np.zeros(len(world.modules))
        self._tick = 0
        self._inside: dict[int, _Agent] = {}
        self._outside: dict[int, _Agent] = {}
        self._barrier: Barrier | None = None
        self._clock = work_space()
        self._poll = select.poll()
        rehearse(world if isinstance(world, TruthLog) else None)
        self._listener = _listen(path)
        self._poll.register(self._listener, select.POLLIN)
        self._before_hello: set[int] = set()
        self._is_full = False

    @property
    def ticks(self) -> int:
        """How many ticks the world has been stepped."""
        return self._tick

    @property
    def attached(self) -> tuple[str, ...]:
        """The serials whose agents are in the barrier, in the order of the world."""
        slots = sorted(slot for agent in self._inside.values() for slot in agent.slots)
        return tuple(self._world.modules[slot].serial for slot in slots)

    def tick(self) -> None:
        """Collect the PWM of the attached agents, step the world once, send out the samples."""
        self._complete(self._inside_barrier().collect(self._tick, self._pwm))

    def _complete(self, answered: int) -> None:
        """Go on with a tick from where a kernel left it: so many agents have answered as they should."""
        self._collect(answered)
        self._look_outside()
        readings = self._world.exchange(tuple(self._pwm.tolist()))
        self._pass_ticks(1)
        barrier = self._inside_barrier()
        self._send_on(readings, barrier.distribute(self._tick, readings, 0))

    def _run_ahead(self, truth: TruthLog, pace: Words) -> None:
        """Run some ticks in one call, as far as all agents answer as they should and nothing else comes."""
        if self._before_hello or self._poll.poll(0):
            # Who comes inside is sent the samples of this tick before it is to answer.
            if keep_pace(pace, self._clock):
                self.tick()
            return
        run = self._inside_barrier().run(truth, self._tick, _MANY_TICKS, self._pwm, pace)
        self._pass_ticks(run.ticks)
        if run.ticks:
            self._send_on(truth.world.readings, run.sent)
        if run.answered is not None:
            self._complete(run.answered)

    def _look_outside(self) -> None:
        for descriptor, _ in self._poll.poll(0):
            self._attend(descriptor)
        if self._before_hello:
            self._drop_squatters()

    def _pass_ticks(self, ticks: int) -> None:
        before, self._tick = self._tick, self._tick + ticks
        if before // _WINDOW_TICKS != self._tick // _WINDOW_TICKS:
            for agent in self._inside.values():
                agent.late_ticks = 0

    def _send_on(self, readings: Readings, sent: int) -> None:
        """Send the samples of the last tick to the agents that a kernel has not reached."""
        barrier, agents = self._inside_barrier(), list(self._inside.values())
        while sent < barrier.size:
            self._send(
                agents[sent], agents[sent].frames.pack_samples(self._tick, readings, agents[sent].slots)
            )
            sent = barrier.distribute(self._tick, readings, sent + 1)

    def _inside_barrier(self) -> Barrier:
        """Return the agents inside as arrays, which are made anew when one has come or gone."""
        if self._barrier is None:
            slots = [agent.slots for agent in self._inside.values()]
            self._barrier = Barrier(list(self._inside), slots, self._bound_s, SLOW_S)
        return self._barrier

    def run(self, speed: float | None, stop: Callable[[], bool], tick_s: float = 0.001) -> RunReport:
        """Tick until `stop()`, at `speed` times real time, or as fast as it goes when None; then close.

        Up to 20 ms of lag are caught up, what is beyond is given up and counted.

        Args:
            speed: simulated over real time, > 0.
            stop: asked before every tick.
            tick_s: simulated time of one tick [s].
        """
        if speed is not None and not speed > 0.0:
            raise ValueError(f"speed is a positive number or None, not {speed}")
        start_s, first_tick = time.monotonic(), self._tick
        period_ns = 0 if speed is None else round(1e9 * tick_s / speed)
        pace = new_pace(time.monotonic_ns(), period_ns, round(1e9 * _MAX_LAG_S))
        world = self._world
        try:
            while not stop():
                if isinstance(world, TruthLog) and world.ticks_ahead:
                    self._run_ahead(world, pace)
                elif keep_pace(pace, self._clock):
                    self.tick()
        finally:
            self.close()
        slipped_s = 1e-9 * float(pace[SLIPPED])
        elapsed_s = time.monotonic() - start_s
        ticks = self._tick - first_tick
        achieved = ticks * tick_s / elapsed_s if elapsed_s > 0.0 else 0.0
        return RunReport(ticks, ticks * tick_s, elapsed_s, slipped_s, achieved)

    def close(self) -> None:
        """Hang up on all agents and remove the socket. May be called twice."""
        if self._listener.fileno() < 0:
            return
        self._listener.close()
        os.unlink(self._path)
        for agent in (*self._inside.values(), *self._outside.values()):
            agent.connection.close()
        self._inside.clear()
        self._outside.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # ------------------------------------------------------------------- inside the barrier

    def _collect(self, answered: int) -> None:
        """Hear the agents of a tick after those that have answered as they should."""
        barrier, agents = self._inside_barrier(), list(self._inside.values())
        for agent, late in zip(agents, barrier.late.tolist(), strict=True):
            if late:
                self._count_late(agent)
        before_s = time.monotonic()
        for k, agent in enumerate(agents[answered:], answered):
            # Only after a straggler the others do not get the full bound again.
            frame = barrier.answer(k)
            if frame is None:
                frame = self._receive(agent, before_s < barrier.until_s)
            now_s = time.monotonic()
            if now_s - before_s > SLOW_S:
                self._count_late(agent)
            before_s = now_s
            if frame is None:
                self._exclude(agent)
            else:
                self._apply(agent, frame)

    def _receive(self, agent: _Agent, wait: bool) -> bytes | None:
        """Return the next frame, b"" when the agent is gone, None when the barrier's time is up."""
        size = agent.frames.pwm.size + 1
        # The socket's own receive time-out is the bound: one system call, whether or not it has to wait.
        try:
            return agent.connection.recv(size, 0 if wait else socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        except ConnectionError:
            return b""

    def _apply(self, agent: _Agent, frame: bytes) -> None:
        if not frame:
            self._drop(agent, "is gone")
            return
        try:
            tick, pwm = agent.frames.unpack_pwm(frame)
            if tick != self._tick:
                raise FrameError(f"it answers tick {tick} where {self._tick} is due")
        except FrameError as error:
            self._drop(agent, f"is dropped: {error}")
            return
        for slot, value in zip(agent.slots, pwm, strict=True):
            self._pwm[slot] = value

    def _exclude(self, agent: _Agent) -> None:
        self._report(f"{agent.name} does not answer within {self._bound_s} s: zero PWM until it does")
        self._release(agent)
        agent.silent_since_s = time.monotonic()
        descriptor = agent.connection.fileno()
        del self._inside[descriptor]
        self._barrier = None
        self._outside[descriptor] = agent
        self._poll.register(descriptor, select.POLLIN)

    def _count_late(self, agent: _Agent) -> None:
        agent.late_ticks += 1
        if agent.late_ticks == SLOW_TICKS and not agent.named:
            agent.named = True
            self._report(
                f"{agent.name} is slow: the world waited over {1e3 * SLOW_S:.0f} ms for it {SLOW_TICKS} times"
                f" within {_WINDOW_TICKS} ticks; give its process fewer modules, or the machine less to do"
            )

    # ------------------------------------------------------------------- outside the barrier

    def _attend(self, descriptor: int) -> None:
        """Serve what is ready outside the barrier: a new connection, a hello, or an answer long due."""
        if descriptor == self._listener.fileno():
            try:
                connection, _ = self._listener.accept()
            except OSError as error:
                # Those who are silent for too long make room.
                if not self._is_full:
                    self._report(f"no more processes can attach for now: {error.strerror}")
                self._is_full = True
                return
            self._is_full = False
            _set_receive_timeout(connection, self._bound_s)
            self._outside[connection.fileno()] = _Agent(connection)
            self._before_hello.add(connection.fileno())
            self._poll.register(connection, select.POLLIN)
            return
        agent = self._outside.get(descriptor)
        if agent is None:
            # Dropped a moment ago, in favour of its successor.
            return
        try:
            frame = agent.connection.recv(MAX_HANDSHAKE_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            # The descriptor is that of a new connection already.
            return
        except ConnectionError:
            frame = b""
        if not frame:
            self._drop(agent, "is gone")
        elif agent.slots:
            self._readmit(agent, frame)
        else:
            self._welcome(agent, frame)

    def _drop_squatters(self) -> None:
        now_s = time.monotonic()
        for descriptor in list(self._before_hello):
            agent = self._outside[descriptor]
            if now_s - agent.silent_since_s > HELLO_S:
                self._drop(agent, f"is dropped: no hello within {HELLO_S:g} s")

    def _readmit(self, agent: _Agent, frame: bytes) -> None:
        try:
            # The tick that it answers is over, and with it its PWM; only the form is checked.
            agent.frames.unpack_pwm(frame)
        except FrameError as error:
            self._drop(agent, f"is dropped: {error}")
            return
        descriptor = agent.connection.fileno()
        del self._outside[descriptor]
        self._poll.unregister(descriptor)
        self._inside[descriptor] = agent
        self._barrier = None
        self._report(f"{agent.name} is in step from tick {self._tick + 1}")

    def _welcome(self, agent: _Agent, frame: bytes) -> None:
        try:
            serials = unpack_hello(frame)
            self._check_free(serials)
        except FrameError as error:
            if self._send(agent, pack_refusal(str(error))):
                self._drop(agent, f"is refused: {error}")
            return
        self._before_hello.discard(agent.connection.fileno())
        agent.silent_since_s = time.monotonic()
        agent.serials = serials
        agent.slots = tuple(self._slot_of[serial] for serial in serials)
        agent.frames = TickFrames.of(len(serials))
        modules = tuple(self._world.modules[slot] for slot in agent.slots)
        self._send(agent, pack_welcome(Welcome(self._tick, modules)))

    def _check_free(self, serials: Sequence[str]) -> None:
        for serial in serials:
            if serial not in self._slot_of:
                known = ", ".join(self._slot_of)
                raise FrameError(f"no module {serial!r} in this world; there are {known}")
            for holder in (*self._inside.values(), *self._outside.values()):
                if serial not in holder.serials:
                    continue
                # An agent that died and is started again may be faster than the news of its death.
                if holder.hung_up():
                    self._drop(holder, "is gone")
                elif self._abandoned(holder):
                    self._drop(holder, f"is dropped for another agent: no answer for {ABANDONED_S:g} s")
                else:
                    raise FrameError(f"module {serial!r} has an agent already")

    def _abandoned(self, agent: _Agent) -> bool:
        outside = agent.connection.fileno() in self._outside
        return outside and time.monotonic() - agent.silent_since_s > ABANDONED_S

    # ------------------------------------------------------------------- ends

    def _send(self, agent: _Agent, frame: bytes) -> bool:
        try:
            agent.connection.send(frame, socket.MSG_DONTWAIT)
        except OSError as error:
            self._drop(agent, f"is gone: {error.strerror}")
            return False
        return True

    def _release(self, agent: _Agent) -> None:
        for slot in agent.slots:
            self._pwm[slot] = 0.0

    def _drop(self, agent: _Agent, why: str) -> None:
        self._report(f"{agent.name} {why}")
        self._release(agent)
        descriptor = agent.connection.fileno()
        self._before_hello.discard(descriptor)
        self._barrier = None
        if self._inside.pop(descriptor, None) is None:
            del self._outside[descriptor]
            self._poll.unregister(descriptor)
        agent.connection.close()


def _set_receive_timeout(connection: socket.socket, bound_s: float) -> None:
    seconds = int(bound_s)
    microseconds = max(1, round((bound_s - seconds) * 1e6))
    connection.setblocking(True)
    # A C `struct timeval`.
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", seconds, microseconds))


def _listen(path: str) -> socket.socket:
    _clear(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(path)
    except OSError as error:
        listener.close()
        hint = "; the path of a Unix socket has at most 107 bytes" if len(os.fsencode(path)) > 107 else ""
        raise UsageError(f"cannot make the bus socket {path}: {error}{hint}") from error
    listener.listen(_BACKLOG)
    listener.setblocking(False)
    return listener


def _clear(path: str) -> None:
    """Remove the socket of a world that has ended."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        # There is none, or binding will tell what is wrong with the path.
        return
    if not stat.S_ISSOCK(mode):
        raise UsageError(f"{path} is a file, not a socket; give another bus path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            os.unlink(path)
            return
    raise BusInUse(f"another world listens on {path}; stop it, or give another bus path")
