"""How a network misbehaves: the parameters of `impaired_transport`, and the named profiles."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

ProfileName = Literal["none", "lan", "lossy", "wifi", "bad"]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Milliseconds = Annotated[float, Field(ge=0.0, le=10_000.0)]


class NetworkProfile(BaseModel):
    """One way through a network: delay = base + gamma-distributed jitter, loss, reordering, duplication.

    `delay_ms` is the least delay, `jitter_ms` the mean of what comes on top and `jitter_shape` the gamma
    shape (1 = exponential; smaller has the heavier tail). Messages keep their order, as over one TCP link,
    but for the fraction `reorder`, which is delivered at its own time. `loss` drops, `duplicate` delivers
    twice.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str
    delay_ms: Milliseconds = 0.0
    jitter_ms: Milliseconds = 0.0
    jitter_shape: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    loss: Probability = 0.0
    reorder: Probability = 0.0
    duplicate: Probability = 0.0


PROFILES: dict[str, NetworkProfile] = {
    p.name: p
    for p in (
        NetworkProfile(name="none"),
        # A switched 100 Mbps segment: the real module's round trip is 0.70 ms in the median, 1.6 ms at most.
        NetworkProfile(name="lan", delay_ms=0.25, jitter_ms=0.1, jitter_shape=2.0),
        # The same segment with a bad plug: nothing is late, one message in twenty is lost.
        NetworkProfile(name="lossy", delay_ms=0.25, jitter_ms=0.1, jitter_shape=2.0, loss=0.05),
        NetworkProfile(
            name="wifi",
            delay_ms=1.5,
            jitter_ms=3.0,
            jitter_shape=0.7,
            loss=0.01,
            reorder=0.01,
            duplicate=0.001,
        ),
        NetworkProfile(
            name="bad",
            delay_ms=10.0,
            jitter_ms=20.0,
            jitter_shape=0.5,
            loss=0.05,
            reorder=0.05,
            duplicate=0.01,
        ),
    )
}


def profile(name: str) -> NetworkProfile:
    """Look up a profile by name.

    Raises:
        KeyError: unknown profile; the message lists the known ones.
    """
    if name not in PROFILES:
        raise KeyError(f"unknown network profile {name!r}; known are {', '.join(PROFILES)}")
    return PROFILES[name]
