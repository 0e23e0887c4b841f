"""The farthest times that a message may tell are mapped within 64 bits, to what a double tells apart."""

from fractions import Fraction

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.torque_information.serialisation import clocks_of
from module_agent.wire.information_messages import MAX_OFFSET_NS, MAX_TIME_NS, ClockPart

# A tenth of 1e19 ns, the longest time since an origin, is a double to 128 ns; a few roundings make that. Sums
# that leave 64 bits are off by 1.8e19 ns.
TOLERANCE_NS = 2000
ENDS = st.sampled_from([MAX_TIME_NS, -MAX_TIME_NS])


@settings(max_examples=500, deadline=None, derandomize=True)
@given(
    session_ns=ENDS | st.integers(-MAX_TIME_NS, MAX_TIME_NS),
    origin_ns=st.just(MAX_TIME_NS) | st.integers(0, MAX_TIME_NS),
    offset_ns=ENDS.map(float) | st.floats(-MAX_OFFSET_NS, MAX_OFFSET_NS),
    drift=st.sampled_from([-0.1, 0.1]) | st.floats(-0.1, 0.1),
)
def test_the_farthest_times_map_as_in_exact_arithmetic_and_back(
    session_ns: int, origin_ns: int, offset_ns: float, drift: float
) -> None:
    (clock,) = clocks_of([ClockPart(origin_ns=origin_ns, offset_ns=offset_ns, drift=drift)])
    rate = Fraction(drift)
    exact = (session_ns - Fraction(offset_ns) + rate * origin_ns) / (1 + rate)
    module_ns = clock.to_module(np.array([session_ns], dtype=np.int64))
    assert abs(int(module_ns[0]) - exact) < TOLERANCE_NS
    assert abs(int(clock.to_session(module_ns)[0]) - session_ns) < TOLERANCE_NS
