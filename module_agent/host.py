"""One agent process: the modules that it hosts, between their hardware and the transport.

`cycle` runs one tick of all of them. The same host runs in real time on the physics bus and Zenoh, and in
virtual time inside the simulator; only hardware, transport and worker differ.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from module_agent.control.controller import Command
from module_agent.estimate.observer import Finding, Observer
from module_agent.firmware.bus_run import MANY_TICKS, BusRun
from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.firmware import Answer, Firmware, Incoming, Outgoing, acknowledgement
from module_agent.firmware.quiet_ticks import NOT_QUIET, ROW_DUE, QuietTicks
from module_agent.hardware.hardware import Modules, ModuleSample, Readings
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.errors import RobotError
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.peers.motion_listener import AskHistory, JointMotion, Listen, MotionListener
from module_agent.peers.row_collection import MotionCollection, OwnRows
from module_agent.torque_information.service import InformationService, Worker
from module_agent.transport.inbox import Inbox
from module_agent.transport.transport import (
    Event,
    Reply,
    Request,
    Sample,
    Sink,
    Transport,
    Undeclare,
)
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.information_messages import CollectRequest, Information, InformationRequest
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import (
    Ack,
    Estimate,
    EstimateRequest,
    Feedback,
    HistoryRequest,
    LeaseRequest,
    Message,
    Status,
)
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.topics import PUBLISHED_TO_MODULE, SERVED, TOPICS

HISTORY_TIMEOUT_S = 0.4
# A question whose answer is dropped on arrival would otherwise be remembered for ever.
MAX_ASKED = 1024
# So many rows of motions may wait for their estimates: of 64 joints that moved at once for two minutes. The
# shortest motion counts as so many, as a job has a size by itself.
MAX_WAITING_ROWS, MIN_ROWS = 2_000_000, 100
# Who keeps a lease alive sends fewer renewals within a tick; more of them are read like all else.
MAX_RENEWALS = 4

T = TypeVar("T")
M = TypeVar("M", Status, Feedback, Ack)


class InlineWorker:
    """Runs a job at once, for virtual time."""

    def submit(self, job: Callable[[], T], done: Callable[[T], None]) -> None:
        """Run the job now."""
        done(job())

    def check(self) -> None:
        """Nothing is left to raise: a job raises where it runs."""


class HostedModule:
    """One module of this process: its firmware, its observer, and their inboxes."""

    def __init__(self, robot: str, config: FirmwareConfig, modules: Modules, index: int, host: "AgentHost"):
        self._host = host
        self._information = InformationService(config.serial, host.collection, host.worker)
        self.serial = config.serial
        self.firmware = Firmware(config, modules, index)
        self.observer = Observer(config.serial, config.boot, IMU_PRIORS[config.imu])
        self.inbox = Inbox(MAX_MESSAGE_BYTES, bell=host.bell)
        # Apart from all else, and read to its end in every tick: no flood of garbage keeps a stop out.
        self.stops = Inbox(TOPICS[Leaf.STOP].max_bytes_to_module, bell=host.bell)
        self.now_ns = 0
        self.requests: dict[int, Request] = {}
        self._request_id = 0
        self._arrived: list[Event] = []
        # What has arrived, if that is nothing but renewals of the lease: a quiet tick is quiet all the same.
        self.renewals: list[Incoming] = []
        self._answers: list[Outgoing] = []
        self._seq = 0
        self._keys = {leaf: key(robot, config.serial, leaf) for leaf in Leaf}
        self._leaves = {text: leaf for leaf, text in self._keys.items()}

    def key(self, leaf: Leaf) -> str:
        """Return the key of one of this module's leaves."""
        return self._keys[leaf]

    def sink(self, leaf: Leaf) -> Sink:
        """Return the inbox of a leaf."""
        return self._put_stop if leaf is Leaf.STOP else self.inbox.put

    def _put_stop(self, event: Event) -> None:
        """Enqueue what arrives on the key of stops: garbage with all else, which refuses it in its turn."""
        if not isinstance(event, Request | Sample):
            return
        try:
            self.firmware.admission.read(Leaf.STOP, event.payload)
        except WireError:
            self.inbox.put(event)
        else:
            self.stops.put(event)

    def collect(self) -> bool:
        """Take what has arrived by now, if anything; its age is judged by the time of the next sample."""
        if self.stops.waiting or self.inbox.waiting:
            self._arrived = self.stops.drain(limit=len(self.stops)) + self.inbox.drain()
            self.firmware.dropped_events = self.inbox.dropped + self.stops.dropped
            self.renewals = self._only_renewals()
        return bool(self._arrived)

    def _only_renewals(self) -> list[Incoming]:
        read: list[tuple[Request | Sample, Message]] = []
        for event in self._arrived if len(self._arrived) <= MAX_RENEWALS else ():
            if not isinstance(event, Request | Sample) or self._leaves[event.key] is not Leaf.LEASE:
                return []
            try:
                message = self.firmware.admission.read(Leaf.LEASE, event.payload)
            except WireError:
                return []
            if not isinstance(message, LeaseRequest) or message.action != "renew":
                return []
            read.append((event, message))
        return [Incoming(Leaf.LEASE, event.payload, self._number(event), message) for event, message in read]

    def step(self, sample: ModuleSample) -> Command:
        """Begin a tick on what was collected before the sample was taken; return the module's command."""
        self.now_ns = max(0, sample.sensors.t_ns)
        if not self._arrived:
            return self.firmware.step(sample, ())
        incoming, self.renewals = self.renewals, []
        for event in () if incoming else self._arrived:
            self._sort(event, incoming)
        self._arrived = []
        return self.firmware.step(sample, incoming)

    def read_renewals(self, quiet: QuietTicks, place: int) -> list[Outgoing]:
        """Read the renewals that were collected before a tick that was quiet; return what to send."""
        renewals, self.renewals, self._arrived = self.renewals, [], []
        return quiet.read_renewals(place, renewals)

    def publish(self, pwm: float) -> list[Outgoing]:
        """End a tick with the module's PWM; return what to send."""
        out = self.firmware.publish(pwm)
        if self._answers:
            out, self._answers = self._answers + out, []
        return out

    def _sort(self, event: Event, incoming: list[Incoming]) -> None:
        if not isinstance(event, Request | Sample):
            return
        leaf, number = self._leaves[event.key], self._number(event)
        if TOPICS[leaf].answered_by == "host" and number is not None:
            self._answers.append(Answer(number, self._answer(leaf, event.payload)))
        else:
            incoming.append(Incoming(leaf, event.payload, number))

    def _number(self, event: Request | Sample) -> int | None:
        """Return the number by which a question is answered, None for a publication."""
        if not isinstance(event, Request):
            return None
        self._request_id += 1
        self.requests[self._request_id] = event
        return self._request_id

    def _answer(self, leaf: Leaf, payload: bytes) -> bytes:
        try:
            return encode(self._answer_message(self.firmware.admission.read(leaf, payload)))
        except WireError as error:
            # A result that is not ready yet is requested again; that is no fault of the sender's.
            if error.reason is not Refusal.BUSY:
                self.firmware.admission.count(error.reason)
            return encode(self._ack(0, error))

    def _answer_message(self, request: Message) -> Message:
        match request:
            case EstimateRequest():
                finding = self.observer.findings.get(request.joint)
                if finding is None:
                    raise WireError(Refusal.GONE, f"{self.serial} has no estimate of joint {request.joint}")
                return self.estimate(finding)
            case CollectRequest():
                self._information.collect(request, self._host.own_rows, self._host.now_ns)
                return self._ack(request.seq)
            case InformationRequest():
                answer = self._information.answer(request)
                return Information(**self._head(), **answer._asdict())
            case _:
                raise WireError(Refusal.MALFORMED, f"{type(request).__name__} is not answered by the host")

    def _head(self) -> dict[str, Any]:
        self._seq += 1
        return {"serial": self.serial, "boot": self.firmware.config.boot, "seq": self._seq}

    def _ack(self, re: int, refused: WireError | None = None) -> Ack:
        return acknowledgement(self._head(), self.firmware.lease, self.now_ns, re, refused)

    def estimate(self, finding: Finding) -> Estimate:
        """Return the message that publishes a finding."""
        return Estimate(**self._head(), **finding._asdict())


class AgentHost:
    """All modules of one agent process. Declares everything on construction; `close` ends it.

    With simulated modules, most ticks of most modules are run by `QuietTicks`: its own, or those that several
    hosts of one process share, where this one's modules have the places from `place` on.
    """

    def __init__(
        self,
        robot: str,
        modules: Modules,
        transport: Transport,
        configs: Sequence[FirmwareConfig],
        worker: Worker,
        quiet: QuietTicks | None = None,
        place: int = 0,
    ):
        self.worker = worker
        self.collection = MotionCollection()
        # Rung by whatever arrives, for a kernel that runs ticks until then.
        self.bell = memoryview(bytearray(1))
        self.modules = [
            HostedModule(robot, config, modules, index, self) for index, config in enumerate(configs)
        ]
        self._robot = robot
        self._hardware = modules
        self._transport = transport
        self._motion_listener = MotionListener()
        self._from_others = Inbox(MAX_MESSAGE_BYTES, bell=self.bell)
        # Of each module, and how many rows its motion had if no other estimate waits for them.
        self._findings: list[tuple[HostedModule, Finding, int]] = []
        self._waiting_rows = 0
        self._listening: dict[str, Undeclare] = {}
        self._declared: list[Undeclare] = []
        self._asked: dict[int, AskHistory] = {}
        self._tag = 0
        self._seq = 0
        self._place = place
        self._quiet = quiet
        # Whether leases are renewed in this tick of modules that may be quiet.
        self._renews = False
        self._bus_run: BusRun | None = None
        if isinstance(modules, LoopInside):
            self._loops = modules
            self._quiet = quiet = quiet or QuietTicks(len(self.modules))
            for index, module in enumerate(self.modules):
                quiet.attach(place + index, module.firmware, modules, index)
            if modules.bus is not None:
                bell = np.frombuffer(self.bell, np.uint8)
                self._bus_run = BusRun(modules, modules.bus, quiet, bell)
        self._declare()

    @property
    def own_rows(self) -> dict[str, OwnRows]:
        """The rows of the process's own modules."""
        firmwares = (module.firmware for module in self.modules)
        return {each.config.serial: OwnRows(each.config.boot, each.history) for each in firmwares}

    @property
    def now_ns(self) -> int:
        """The time of one steady clock of the process: that of its first module."""
        return self.modules[0].now_ns

    def _declare(self) -> None:
        transport, declared = self._transport, self._declared
        for module in self.modules:
            declared += [transport.serve(module.key(leaf), module.sink(leaf)) for leaf in SERVED]
            declared += [
                transport.subscribe(module.key(leaf), module.sink(leaf)) for leaf in PUBLISHED_TO_MODULE
            ]
        declared.append(transport.subscribe(every(self._robot, Leaf.MOTION), self._from_others.put))
        # Last, so that everything else is in place when the token is seen.
        declared += [transport.declare_alive(module.key(Leaf.ALIVE)) for module in self.modules]

    def cycle(self) -> None:
        """Run one tick of all modules: receive samples, send commands, publish.

        On a physics bus it may be several, the last of which needs more than the modules' loops.

        Raises:
            HardwareLost: no further tick will come.
        """
        # Before the look: what arrives after it rings again.
        self.bell[0] = 0
        busy = self.collect()
        if self._bus_run is not None:
            self._cycle_on_bus(self._bus_run, busy)
            return
        if self._quiet is not None:
            readings = self._loops.exchange(self._quiet.pwm.tolist())
            self.finish(readings, self._quiet.run(readings, busy))
            return
        samples, modules = self._hardware.receive(), self.modules
        if self._from_others.waiting:
            self._read_others()
        commands = [module.step(sample) for module, sample in zip(modules, samples, strict=True)]
        for module, pwm in zip(modules, self._hardware.send(commands), strict=True):
            for outgoing in module.publish(pwm):
                self._send(module, outgoing)
        self._attend()

    def _cycle_on_bus(self, bus: BusRun, busy: list[int]) -> None:
        assert self._quiet is not None
        if self._renews:
            # A tick that is quiet for all modules is answered before they are read.
            self.bell[0] = 1
        results = bus.run(busy, 1 if busy or self.has_work else MANY_TICKS)
        self.finish(bus.readings, results)

    def collect(self) -> list[int]:
        """Take what has arrived for the modules; return the places of those that cannot be quiet for it.

        Before the sample: a process that freezes while it waits gets an old sample when it thaws; by the time
        of that sample all commands that arrived meanwhile would be fresh.
        """
        busy = []
        for place, module in enumerate(self.modules, self._place):
            if module.collect():
                if module.renewals and self._quiet is not None:
                    self._renews = True
                else:
                    busy.append(place)
        return busy

    def finish(self, readings: Readings, results: Sequence[int]) -> None:
        """Run what quiet ticks have left of a tick: modules that need their objects, and all that is sent."""
        quiet, places = self._quiet, range(self._place, self._place + len(self.modules))
        assert quiet is not None
        self._renews = False
        if self.has_work or any(results[place] == NOT_QUIET for place in places):
            quiet.keep_held(places)
        if self._from_others.waiting:
            # Their times are those of the last tick until the modules are run.
            for place, module in enumerate(self.modules, self._place):
                module.now_ns = max(0, quiet.before_ns[place])
            self._read_others()
        for index, module in enumerate(self.modules):
            place = self._place + index
            module.now_ns = max(0, quiet.now_ns[place])
            if results[place] == NOT_QUIET:
                quiet.load(place)
                command = module.step(self._loops.take(index, readings[place]))
                out = module.publish(self._loops.run(index, command))
                quiet.store(place)
            else:
                out = module.read_renewals(quiet, place) if module.renewals else []
                if results[place] == ROW_DUE:
                    out += quiet.keep_rows(place)
            for outgoing in out:
                self._send(module, outgoing)
        self._attend()

    @property
    def has_work(self) -> bool:
        """Whether `finish` has anything to do in a tick that is quiet for all modules."""
        listener = self._motion_listener
        return bool(
            self._renews
            or self._from_others.waiting
            or listener.has_work
            or self.collection.has_work
            or self._findings
        )

    def _attend(self) -> None:
        if self._motion_listener.has_work:
            self._attend_to_motions()
        if self.collection.has_work:
            for wanted in self.collection.poll(self.now_ns):
                self._ask_history(wanted)
        self.worker.check()
        if self._findings:
            self._publish_findings()

    def _send(self, module: HostedModule, outgoing: Outgoing) -> None:
        if isinstance(outgoing, Answer):
            module.requests.pop(outgoing.request).reply(outgoing.payload)
        else:
            self._transport.publish(module.key(outgoing.leaf), outgoing.payload)

    def _read_others(self) -> None:
        clocks = {module.serial: module.now_ns for module in self.modules}
        for event in self._from_others.drain(limit=512):
            try:
                self._on_event(event, clocks)
            except RobotError as error:
                # Whatever a message leads to ends with that message.
                reason = error.reason if isinstance(error, WireError) else Refusal.MALFORMED
                for module in self.modules:
                    module.firmware.admission.count(reason)

    def _on_event(self, event: Event, clocks: dict[str, int]) -> None:
        if isinstance(event, Reply):
            asked = self._asked.pop(event.tag, None)
            if event.payload is not None and asked is not None:
                self._on_history(asked, event.payload, clocks)
        if not isinstance(event, Sample):
            return
        _, serial, leaf = parse(event.key)
        max_bytes = TOPICS[leaf].max_bytes_from_module
        if leaf is Leaf.MOTION:
            status = _of(serial, decode(Status, event.payload, max_bytes))
            self._motion_listener.on_status(status, self.now_ns, clocks)
        else:
            feedback = _of(serial, decode(Feedback, event.payload, max_bytes))
            self._motion_listener.on_feedback(feedback, clocks)

    def _on_history(self, asked: AskHistory, payload: bytes, clocks: dict[str, int]) -> None:
        try:
            feedback = decode(Feedback, payload, TOPICS[Leaf.HISTORY].max_bytes_from_module)
        except WireError:
            # An answer too; anything else is malformed.
            refused = _of(asked.serial, decode(Ack, payload))
            if refused.reason in (Refusal.GONE.value, Refusal.WRONG_BOOT.value):
                self.collection.on_lost(asked)
            return
        self._motion_listener.on_feedback(feedback, clocks, live=False)
        self.collection.on_feedback(feedback)

    def _attend_to_motions(self) -> None:
        requests, motions = self._motion_listener.poll(self.now_ns)
        for wanted in requests:
            if isinstance(wanted, Listen):
                self._listen(wanted)
            else:
                self._ask_history(wanted)
        for motion in motions:
            rows = max(len(motion.rows), MIN_ROWS)
            if self._waiting_rows + rows > MAX_WAITING_ROWS:
                # Motions are announced faster than they can have been made.
                for module in self.modules:
                    module.firmware.admission.count(Refusal.LIMIT)
                continue
            self._waiting_rows += rows
            for module in self.modules:
                self._submit(module, motion, rows if module is self.modules[-1] else 0)

    def _publish_findings(self) -> None:
        while self._findings:
            module, finding, rows = self._findings.pop(0)
            self._waiting_rows -= rows
            module.observer.keep(finding)
            self._transport.publish(module.key(Leaf.ESTIMATE), encode(module.estimate(finding)))

    def _submit(self, module: HostedModule, motion: JointMotion, rows: int) -> None:
        job = module.observer.job(motion, module.firmware.history, module.firmware.last_rest)

        def done(finding: Finding) -> None:
            self._findings.append((module, finding, rows))
            self.bell[0] = 1

        self.worker.submit(job, done)

    def _listen(self, wanted: Listen) -> None:
        subscription = self._listening.pop(wanted.serial, None)
        if subscription is not None:
            subscription.undeclare()
        if wanted.on:
            self._listening[wanted.serial] = self._transport.subscribe(
                key(self._robot, wanted.serial, Leaf.FEEDBACK), self._from_others.put
            )

    def _ask_history(self, wanted: AskHistory) -> None:
        self._tag += 1
        self._seq += 1
        self._asked[self._tag] = wanted
        if len(self._asked) > MAX_ASKED:
            del self._asked[next(iter(self._asked))]
        question = HistoryRequest(
            serial=wanted.serial,
            boot=wanted.boot,
            seq=self._seq,
            sender=self.modules[0].serial,
            first_row=wanted.first_row,
            end_row=wanted.end_row,
        )
        self._transport.query(
            key(self._robot, wanted.serial, Leaf.HISTORY),
            encode(question),
            HISTORY_TIMEOUT_S,
            self._from_others.put,
            self._tag,
        )

    def close(self) -> None:
        """Leave the network and release the modules, whose motors then are off."""
        for declared in [*self._listening.values(), *reversed(self._declared)]:
            declared.undeclare()
        self._listening.clear()
        self._declared.clear()
        self._transport.close()
        self._hardware.close()


def _of(serial: str, message: M) -> M:
    if message.serial != serial:
        raise WireError(Refusal.WRONG_SERIAL, f"{message.serial} speaks on the key of {serial}")
    return message
