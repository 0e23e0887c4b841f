"""What is said on each key, as one table: purpose, messages, their direction and size.

A module serves the requests of its own keys and answers each with the reply of the table, or refuses it with
an `Ack`. Publications go one way on a key: from the module to everyone who subscribes, or from a coordinator
to the module. Host, firmware, coordinator and recordings read this table; docs/wire.md says how to extend it.
"""

from typing import Literal, NamedTuple

from module_agent.wire.codec import MAX_COMMAND_BYTES, MAX_MESSAGE_BYTES
from module_agent.wire.information_messages import CollectRequest, Information, InformationRequest
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    Ask,
    Estimate,
    EstimateRequest,
    Feedback,
    GainsCommand,
    HistoryRequest,
    Identify,
    Info,
    LeaseRequest,
    Message,
    MotionCommand,
    Setpoint,
    Status,
    Stop,
)

Exchange = Literal["publication", "request", "reply"]


class Topic(NamedTuple):
    """The messages of one leaf. Sizes bound the bytes that a receiver decodes, to and from the module.

    heard_by: coordinators do not listen to publications for `modules`.
    """

    purpose: str
    publication: type[Message] | None = None
    heard_by: Literal["all", "modules"] = "all"
    published_by: Literal["module", "coordinator"] = "module"
    request: type[Message] | None = None
    reply: type[Message] = Ack
    answered_by: Literal["firmware", "host"] = "firmware"
    any_boot: bool = False  # a request with boot 0 is meant for whichever boot is running
    max_bytes_to_module: int = MAX_COMMAND_BYTES
    max_bytes_from_module: int = MAX_COMMAND_BYTES

    @property
    def to_module(self) -> type[Message] | None:
        """The message that a module takes on this leaf, as a request or as a publication."""
        return self.request or (None if self.published_by == "module" else self.publication)

    def message(self, exchange: Exchange) -> type[Message] | None:
        """Return the message type of a publication, request or reply; None if there is none."""
        return {"publication": self.publication, "request": self.request, "reply": self.reply}[exchange]

    def max_bytes(self, exchange: Exchange) -> int:
        """Return how many bytes of a publication, request or reply are decoded at most."""
        sender = {"publication": self.published_by, "request": "coordinator", "reply": "module"}[exchange]
        return self.max_bytes_from_module if sender == "module" else self.max_bytes_to_module


TOPICS: dict[Leaf, Topic] = {
    Leaf.ALIVE: Topic("Liveliness token of a module's agent; it carries no message."),
    Leaf.INFO: Topic("Type, limits, gains and rates of the module.", request=Ask, reply=Info, any_boot=True),
    Leaf.FEEDBACK: Topic(
        "The newest measured rows, in batches.", publication=Feedback, max_bytes_from_module=MAX_MESSAGE_BYTES
    ),
    Leaf.STATUS: Topic(
        "State, lease, motion and refusals: published at every change and at least twice a second.",
        publication=Status,
        request=Ask,
        reply=Status,
        any_boot=True,
    ),
    Leaf.HISTORY: Topic(
        "Measured rows of the last minute, by row number.",
        request=HistoryRequest,
        reply=Feedback,
        max_bytes_from_module=MAX_MESSAGE_BYTES,
    ),
    Leaf.LEASE: Topic(
        "Acquire, renew or release the command of the joint; what is published is not answered.",
        publication=LeaseRequest,
        published_by="coordinator",
        request=LeaseRequest,
    ),
    Leaf.MOTION: Topic(
        "Start a motion that runs on the module; the module announces it to the others by its status.",
        publication=Status,
        heard_by="modules",
        request=MotionCommand,
    ),
    Leaf.SETPOINT: Topic("Stream setpoints to the joint.", publication=Setpoint, published_by="coordinator"),
    Leaf.STOP: Topic(
        "Stop at once; needs no lease.",
        publication=Stop,
        published_by="coordinator",
        request=Stop,
        any_boot=True,
        # The longest has 889; read at the door of the module, in the thread of the network.
        max_bytes_to_module=1024,
    ),
    Leaf.GAINS: Topic("Replace the controller's gains.", request=GainsCommand),
    Leaf.IDENTIFY: Topic(
        "Show by its LED which module this is; needs no lease.", request=Identify, any_boot=True
    ),
    Leaf.ESTIMATE: Topic(
        "The module's own estimate of the motion of one joint.",
        publication=Estimate,
        request=EstimateRequest,
        reply=Estimate,
        answered_by="host",
        any_boot=True,
    ),
    Leaf.COLLECT: Topic(
        "Keep the rows of a motion, the module's own and those of other modules.",
        request=CollectRequest,
        answered_by="host",
        max_bytes_to_module=MAX_MESSAGE_BYTES,
    ),
    Leaf.INFORMATION: Topic(
        "Square-root information of the module's torques in the motions that it has collected.",
        request=InformationRequest,
        reply=Information,
        answered_by="host",
        max_bytes_to_module=MAX_MESSAGE_BYTES,
        max_bytes_from_module=MAX_MESSAGE_BYTES,
    ),
}

SERVED = tuple(leaf for leaf, topic in TOPICS.items() if topic.request)
_PUBLISHED = {leaf: topic.published_by for leaf, topic in TOPICS.items() if topic.publication}
PUBLISHED_BY_MODULE = tuple(leaf for leaf, sender in _PUBLISHED.items() if sender == "module")
HEARD_BY_COORDINATOR = tuple(leaf for leaf in PUBLISHED_BY_MODULE if TOPICS[leaf].heard_by == "all")
PUBLISHED_TO_MODULE = tuple(leaf for leaf, sender in _PUBLISHED.items() if sender == "coordinator")
