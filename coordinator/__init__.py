"""What runs once: discovery, sequencing, chain model, regressor, estimates, viewer, files.

The library face: `from coordinator import load_run, identify, ...`. Each name is imported when it is first
used, so that a program pays only for what it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coordinator.api import connect as connect
    from coordinator.api import denavit_hartenberg as denavit_hartenberg
    from coordinator.api import export_hrdf as export_hrdf
    from coordinator.api import export_urdf as export_urdf
    from coordinator.api import forward_kinematics as forward_kinematics
    from coordinator.api import load_recording as load_recording
    from coordinator.api import load_run as load_run
    from coordinator.arm_fit.data_file import read_log as read_log
    from coordinator.arm_fit.fit_dynamics import fit_dynamics as fit_dynamics
    from coordinator.batch_estimation.imu_prediction import imu_readings as imu_readings
    from coordinator.description.urdf_reader import read_urdf as read_urdf
    from coordinator.identification.identify import identify as identify
    from coordinator.kinematics.encoder_joint import link_from_joint as link_from_joint
    from coordinator.kinematics.imu_pair import link_from_imus as link_from_imus
    from module_agent.model.regressor import inverse_dynamics as inverse_dynamics
    from module_agent.model.regressor import torque_regressor as torque_regressor

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
    "link_from_imus": "coordinator.kinematics.imu_pair",
    "link_from_joint": "coordinator.kinematics.encoder_joint",
    "load_recording": "coordinator.api",
    "load_run": "coordinator.api",
    "read_log": "coordinator.arm_fit.data_file",
    "read_urdf": "coordinator.description.urdf_reader",
    "torque_regressor": "module_agent.model.regressor",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
