"""What runs once: discovery, sequencing, chain model, regressor, estimates, viewer, files.

The library face: `from coordinator import load_run, identify, ...`. Each name is imported when it is first
used, so that a program pays only for what it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coordinator.api import (
        connect,
        denavit_hartenberg,
        export_hrdf,
        export_urdf,
        forward_kinematics,
        load_recording,
        load_run,
    )
    from coordinator.arm_fit.data_file import read_log
    from coordinator.arm_fit.fit_dynamics import fit_dynamics
    from coordinator.batch_estimation.imu_prediction import imu_readings
    from coordinator.description.urdf_reader import read_urdf
    from coordinator.identification.identify import identify
    from coordinator.kinematics.imu_links import link_from_imus, link_from_joint
    from module_agent.model.regressor import inverse_dynamics, torque_regressor

_HOMES = {
    "connect": "coordinator.api",
    "denavit_hartenberg": "coordinator.api",
    "export_hrdf": "coordinator.api",
    "export_urdf": "coordinator.api",
    "fit_dynamics": "coordinator.arm_fit.fit_dynamics",
    "forward_kinematics": "coordinator.api",
    "identify": "coordinator.identification.identify",
    "imu_readings": "coordinator.batch_estimation.imu_prediction",
    "inverse_dynamics": "module_agent.model.regressor",
    "link_from_imus": "coordinator.kinematics.imu_links",
    "link_from_joint": "coordinator.kinematics.imu_links",
    "load_recording": "coordinator.api",
    "load_run": "coordinator.api",
    "read_log": "coordinator.arm_fit.data_file",
    "read_urdf": "coordinator.description.urdf_reader",
    "torque_regressor": "module_agent.model.regressor",
}

__all__ = [
    "connect",
    "denavit_hartenberg",
    "export_hrdf",
    "export_urdf",
    "fit_dynamics",
    "forward_kinematics",
    "identify",
    "imu_readings",
    "inverse_dynamics",
    "link_from_imus",
    "link_from_joint",
    "load_recording",
    "load_run",
    "read_log",
    "read_urdf",
    "torque_regressor",
]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
