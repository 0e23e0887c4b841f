"""The settings of one module's firmware, made before its first tick."""

from typing import Any, NamedTuple

from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.hardware.hardware import ModuleInformation
from module_agent.model.catalogue import ImuKind, ModuleType, module_type
from module_agent.model.errors import UsageError
from module_agent.wire.messages import ExpiryAction, Limits

# What a message carries.
MAX_NAME = 64
# Half a lifetime without a tick counts as a clock that jumped.
MIN_LIFETIME_TICKS = 4


class FirmwareConfig(NamedTuple):
    """The settings of one module's firmware; times and rates in the module's own clock.

    imu: how well the module's IMU is calibrated, the prior of the module's own estimates.
    name, family: what the module's user calls it, and all modules of its robot.
    strategy: the control strategy whose factory gains it begins with; None: the gains that the module has.
    safety: the configured limits, which `limits` has together with those of the type.
    """

    serial: str
    kind: ModuleType
    boot: int
    limits: Limits
    tick_ns: int = 1_000_000
    imu_period_ns: int = 4_000_000
    feedback_rate_hz: float = 250.0
    batch_rows: int = 5
    history_s: float = 60.0
    lifetime_ns: int = 250_000_000
    expiry_action: ExpiryAction = "motor_off"
    strategy: int | None = None
    imu: ImuKind = "uncalibrated"
    name: str = ""
    family: str = ""
    safety: Safety = UNCONFIGURED

    @property
    def history_rows(self) -> int:
        """The number of feedback rows in the history."""
        return int(self.history_s * self.feedback_rate_hz)


def config_of(module: ModuleInformation, boot: int, **settings: Any) -> FirmwareConfig:
    """Return the settings of a module as it describes itself; others as given.

    A row of feedback is measured in a tick, so that there are no more of them than ticks.

    Raises:
        UnknownModuleType: the catalogue has no such type.
    """
    kind, periods = module_type(module.module_type), (module.tick_ns, module.imu_period_ns)
    own: dict[str, Any] = {
        "name": module.name[:MAX_NAME],
        "family": module.family[:MAX_NAME],
        "safety": module.safety,
    }
    config = FirmwareConfig(module.serial, kind, boot, module.limits, *periods, **own | settings)
    return config._replace(feedback_rate_hz=min(config.feedback_rate_hz, 1e9 / config.tick_ns))


def check_config(config: FirmwareConfig) -> FirmwareConfig:
    """Return the configuration if it can be run.

    Raises:
        UsageError: a lifetime that is infinite, over 1 s or of too few ticks, or a rate that a message cannot
        carry.
    """
    if not 0 < config.lifetime_ns <= 1_000_000_000:
        raise UsageError(f"lifetime {config.lifetime_ns / 1e6:g} ms: it must be over 0 and at most 1000 ms")
    if config.lifetime_ns < MIN_LIFETIME_TICKS * config.tick_ns:
        raise UsageError(
            f"lifetime {config.lifetime_ns / 1e6:g} ms: it must be at least {MIN_LIFETIME_TICKS} ticks of "
            f"{config.tick_ns / 1e6:g} ms"
        )
    if not 1.0 <= config.feedback_rate_hz <= 1000.0:
        raise UsageError(f"feedback rate {config.feedback_rate_hz} Hz: it must be 1 to 1000 Hz")
    if not 1 <= config.batch_rows <= 64:
        raise UsageError(f"{config.batch_rows} rows a batch: it must be 1 to 64")
    return config
