"""A module's service of torque information: it keeps rows of motions and computes in the background."""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol, TypeVar

from module_agent.model.errors import RobotError
from module_agent.peers.row_collection import MotionCollection, OwnRows, Track
from module_agent.wire.information_messages import MAX_PART_BYTES, CollectRequest, InformationRequest
from module_agent.wire.refusal import Refusal, WireError

T = TypeVar("T")


class Worker(Protocol):
    """Runs work in the background: on a thread in real time, at once in virtual time."""

    def submit(self, job: Callable[[], T], done: Callable[[T], None]) -> None:
        """Run a job and hand its result to `done`, from any thread."""

    def check(self) -> None:
        """Raise the exception of a failed job."""


class Answer(NamedTuple):
    """Part of a packed `JointInformation`, see `wire.information_messages.Information`."""

    digest: bytes
    motion_ids: tuple[int, ...]
    total_bytes: int
    offset: int
    part: bytes


class InformationService:
    """Answers for one module. The latest result is kept, so that all its parts are from one computation."""

    def __init__(self, serial: str, collection: MotionCollection, worker: Worker):
        self._serial = serial
        self._collection = collection
        self._worker = worker
        self._asked: bytes | None = None
        # The packed information, or the reason why there is none.
        self._result: bytes | str | None = None

    def collect(self, request: CollectRequest, own: Mapping[str, OwnRows], now_ns: int) -> None:
        """Begin to keep the rows of a motion.

        Raises:
            WireError: the rows cannot be kept.
        """
        if self._serial not in (wanted.serial for wanted in request.rows):
            raise WireError(Refusal.RANGE, f"own rows of {self._serial} are not among those to be kept")
        self._collection.collect(request, own, now_ns)

    def answer(self, request: InformationRequest) -> Answer:
        """Return a part of the answer, once it has been computed.

        Raises:
            WireError: BUSY while it is not ready, GONE for a motion that is not kept, UNFIT for a request
                that cannot be computed, RANGE for a part beyond the end.
        """
        digest = request.digest()
        if digest != self._asked:
            self._begin(request, digest)
        result = self._result
        if result is None:
            raise WireError(Refusal.BUSY, f"what the torques of {self._serial} say is being computed")
        if isinstance(result, str):
            raise WireError(Refusal.UNFIT, result)
        total = len(result)
        if request.offset >= total:
            raise WireError(Refusal.RANGE, f"a part from byte {request.offset} on, there are {total}")
        part = result[request.offset : request.offset + MAX_PART_BYTES]
        numbers = tuple(sorted({motion.motion_id for motion in request.motions}))
        return Answer(digest, numbers, total, request.offset, part)

    def _begin(self, request: InformationRequest, digest: bytes) -> None:
        tracks = {motion.motion_id: self._collection.tracks(motion.motion_id) for motion in request.motions}
        if self._asked is not None and self._result is None:
            raise WireError(Refusal.BUSY, f"{self._serial} is computing what another request asks")
        self._asked, self._result = digest, None
        self._worker.submit(lambda: _compute(self._serial, request, tracks), self._keep)

    def _keep(self, result: bytes | str) -> None:
        self._result = result


def _compute(
    serial: str, request: InformationRequest, tracks: Mapping[int, Mapping[str, Track]]
) -> bytes | str:
    # Imported here because loading takes half a second, which would delay the start of every agent.
    from module_agent.torque_information.module_information import own_information
    from module_agent.torque_information.serialisation import pack

    try:
        return pack(own_information(serial, request, tracks))
    except KeyError as error:
        return f"no rows of {error.args[0]} were kept for a motion"
    except RobotError as error:
        # The reason is the answer to the request.
        return str(error)
    except Exception as error:
        # A defect, but caused by a message: it must not end the modules of the process.
        return f"{serial} cannot compute this, {type(error).__name__}: {error}"
