"""How large a gain must be to be called a change, for a rate of false alarms."""

from typing import NamedTuple

import numpy as np

from coordinator.monitoring.likelihood_ratio import gain_above
from coordinator.monitoring.reference import Reference
from coordinator.monitoring.segments import SEGMENT_S
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.regressor import PER_BODY

# What is asked for, of all tests together.
ALARMS_PER_HOUR = 0.1
# A push of less than this share of a joint's largest torque is none.
MIN_CONTACT = 0.01
# Windows of the last so many stretches are tested: short ones for what is large, long ones for what is small.
SPANS = (3, 10)
_DRIVE_FREEDOM, _LINK_FREEDOM = 2, 6


class Thresholds(NamedTuple):
    """Gains, and torques (n,) of a contact [Nm], that chance exceeds as seldom as asked for."""

    payload: float
    link: float
    drive: float
    contact_nm: Array


def thresholds(reference: Reference, alarms_per_hour: float = ALARMS_PER_HOUR) -> Thresholds:
    """Share the allowed rate among contacts, payloads, links and drives, and that of each among its tests.

    Raises:
        UsageError: a rate that is not positive.
    """
    if not (np.isfinite(alarms_per_hour) and alarms_per_hour > 0.0):
        raise UsageError(f"{alarms_per_hour} false alarms an hour cannot be asked for; it must be above 0")
    each, count = alarms_per_hour / 4.0, len(reference.chain.serials)
    effort = np.array([kind.max_effort_nm for kind in reference.types])
    looks = len(SPANS) * 3600.0 / SEGMENT_S
    return Thresholds(
        gain_above(PER_BODY, looks * count, each),
        gain_above(_LINK_FREEDOM, looks * max(len(reference.chain.linked), 1), each),
        gain_above(_DRIVE_FREEDOM, looks * count, each),
        np.maximum(reference.contact.level_nm(each), MIN_CONTACT * effort),
    )
