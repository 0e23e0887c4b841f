"""The impairments of a network, parameters of `channel` and `impaired_transport`, and the named profiles."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from module_agent.network_emulation.trace import NetworkTrace

# The receiver of a message; each direction has its own path.
Receiver = Literal["module", "coordinator"]

# What the jitter is drawn from; mean and variance are the profile's, the tail is the distribution's.
# gamma: Internet delays are a least delay and a gamma (Corlett, Pullin, Sargood: "Statistics of One-Way
#   Internet Packet Delays", 53rd IETF, 2002: shape 2.5, scale 1 ms); shape 1 is the wait in an M/M/1 queue.
# lognormal: the product of many independent slowings; the usual fit where a gamma's tail is too light.
# pareto: the heaviest tail far out, offered by tc-netem(8) for the same purpose; here Lomax, with a variance.
Jitter = Literal["gamma", "lognormal", "pareto"]

Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Milliseconds = Annotated[float, Field(ge=0.0, le=10_000.0)]
Seconds = Annotated[float, Field(ge=0.0, le=1e6)]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Burst(_Strict):
    """Bad times of a path, independent of the traffic.

    Durations and the times between the end of one and the start of the next are exponential, with the means
    `mean_ms` and `apart_s`.
    """

    apart_s: Annotated[float, Field(ge=1e-3, le=1e5)]
    mean_ms: Annotated[float, Field(ge=0.1, le=10_000.0)]


class Stall(Burst):
    """The path passes nothing for a while, then everything that has waited, as a radio off its channel."""


class LossBurst(Burst):
    """The bad state of a Gilbert-Elliott channel, in continuous time; `loss` is that of the bad state.

    Gilbert, "Capacity of a burst-noise channel", 1960; Elliott, 1963. The profile's own `loss` is that of the
    good state. Indoor 802.11 has longer memory (Cardoso and de Rezende, IEEE Communications Letters 13
    (2009)): for that there are recorded traces.
    """

    loss: Probability = 1.0


class PathProfile(_Strict):
    """One direction: delay = base + jitter; loss, stalls, reordering, duplication; or a recorded trace.

    `delay_ms` is the least delay; `spread_ms` lets every endpoint have another: what is added is drawn once,
    uniform up to it. `jitter_ms` is the mean of the added jitter and `jitter_shape` its (mean / standard
    deviation)^2, the shape of a gamma (1 = exponential; smaller has the heavier tail). Messages keep their
    order, as over one TCP link, but for the fraction `reorder`, which is delivered at its own time. `loss`
    drops, `duplicate` delivers twice. Delay and loss of a `trace` are added.
    """

    delay_ms: Milliseconds = 0.0
    spread_ms: Milliseconds = 0.0
    jitter: Jitter = "gamma"
    jitter_ms: Milliseconds = 0.0
    jitter_shape: Annotated[float, Field(ge=0.01, le=100.0)] = 1.0
    loss: Probability = 0.0
    loss_burst: LossBurst | None = None
    stall: Stall | None = None
    reorder: Probability = 0.0
    duplicate: Probability = 0.0
    trace: NetworkTrace | None = None

    @property
    def is_perfect(self) -> bool:
        """Whether every message arrives once and at once."""
        late = self.delay_ms or self.spread_ms or self.jitter_ms or self.stall or self.trace
        return not (late or self.loss or self.loss_burst or self.duplicate)


class NetworkProfile(PathProfile):
    """Both directions of a network, and when the coordinator is cut off.

    Fields of `to_modules` and `to_coordinator` replace those given here for that direction. `partitions`
    are intervals (start, end) [s], in order, in which nothing passes between modules and coordinator, from
    the start of the coordinator's endpoint: it alone is cut off, as clocks of many would not agree on when.
    """

    name: str
    to_modules: PathProfile | None = None
    to_coordinator: PathProfile | None = None
    partitions: tuple[tuple[Seconds, Seconds], ...] = ()

    @model_validator(mode="after")
    def _pareto_has_a_variance(self) -> "NetworkProfile":
        for path in (self.path("module"), self.path("coordinator")):
            if path.jitter == "pareto" and path.jitter_shape >= 1.0:
                raise ValueError(
                    f"jitter_shape is {path.jitter_shape:g}: that of a pareto jitter is less than 1, as its "
                    "standard deviation is larger than its mean"
                )
        return self

    @model_validator(mode="after")
    def _partitions_in_order(self) -> "NetworkProfile":
        last_s = 0.0
        for start_s, end_s in self.partitions:
            if not last_s <= start_s < end_s:
                raise ValueError(
                    f"partitions: ({start_s:g}, {end_s:g}): it must start at {last_s:g} s or later, and end "
                    "after that"
                )
            last_s = end_s
        return self

    def path(self, receiver: Receiver) -> PathProfile:
        """Return the direction that leads to this receiver."""
        own = self.to_modules if receiver == "module" else self.to_coordinator
        common = {name: getattr(self, name) for name in PathProfile.model_fields}
        named = {name: getattr(own, name) for name in own.model_fields_set} if own is not None else {}
        return PathProfile.model_construct(**(common | named))


_LAN = NetworkProfile(name="lan", delay_ms=0.25, jitter_ms=0.1, jitter_shape=2.0)

PROFILES: dict[str, NetworkProfile] = {
    p.name: p
    for p in (
        NetworkProfile(name="none"),
        # A switched 100 Mbps segment: the real module's round trip is 0.70 ms in the median, 1.6 ms at most.
        _LAN,
        # The same segment with a bad plug: nothing is late, one message in twenty is lost.
        _LAN.model_copy(update={"name": "lossy", "loss": 0.05}),
        # Round trips as measured in one room (C. Huitema, "The weird case of the wifi latency spikes", 2023:
        # median 4 ms, 99th percentile 51 ms from stalls that release all that waited), at the busier end. The
        # way up is the worse one: stations contend for the channel, the access point has it more often.
        NetworkProfile(
            name="wifi",
            delay_ms=1.5,
            jitter_ms=2.0,
            jitter_shape=0.7,
            loss=0.003,
            loss_burst=LossBurst(apart_s=1.5, mean_ms=20.0, loss=0.5),
            stall=Stall(apart_s=2.0, mean_ms=20.0),
            reorder=0.01,
            duplicate=0.001,
            to_coordinator=PathProfile(jitter_ms=4.0, loss=0.006),
        ),
        # At the edge of what the default command lifetime tolerates: round trips to 300 ms, 5 % lost in all.
        NetworkProfile(
            name="bad",
            delay_ms=10.0,
            jitter_ms=18.0,
            jitter_shape=0.5,
            loss=0.025,
            loss_burst=LossBurst(apart_s=0.6, mean_ms=30.0, loss=0.5),
            stall=Stall(apart_s=2.0, mean_ms=25.0),
            reorder=0.05,
            duplicate=0.01,
        ),
        # Up takes 6 ms more than down: a clock mapped by round trips is wrong by half of that. Each module's
        # way down is another, so that two modules' clocks are up to 2 ms apart. As of an overloaded uplink.
        NetworkProfile(
            name="asymmetric",
            jitter_ms=0.3,
            jitter_shape=2.0,
            to_modules=PathProfile(delay_ms=0.5, spread_ms=4.0),
            to_coordinator=PathProfile(delay_ms=8.5),
        ),
    )
}
