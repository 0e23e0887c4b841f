"""Parts that `result.json`, `merged.json` and the report of fit-dynamics share."""

from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict

from coordinator.batch_estimation.imu_calibration import ImuCalibration
from coordinator.dynamics.pseudo_inertia import Body
from coordinator.parameter_fit.base_parameters import BaseParameters
from module_agent.model.chain import Array

Triple = tuple[float, float, float]


class Part(BaseModel):
    """A part of a document: immutable, and without fields that the schema does not name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def of(cls, source: object, **fields: Any) -> Self:
        """Return the part with these fields, and of the others those that `source` has, arrays as lists."""
        own = {
            name: getattr(source, name) for name in cls.model_fields.keys() - fields if hasattr(source, name)
        }
        plain = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in own.items()}
        return cls(**plain, **fields)


class BaseParameterPart(Part):
    """A combination of parameters that torques determine, SI units.

    summary: the combination, "m2 c2x + 0.225 (m3 + m4)". relative_sigma: sigma / |value|, null for a value of
    zero.
    """

    summary: str
    value: float
    sigma: float
    relative_sigma: float | None


class BodyPart(Part):
    """A rigid body: mass, centre of mass, and the inertia about it (3, 3), in SI units."""

    mass_kg: float
    com_m: list[float]
    inertia_kg_m2: list[list[float]]


class ImuPlacePart(Part):
    """How a module's IMU is turned and displaced against its catalogued place, in its own axes.

    covariance: (6, 6) of both, by all recordings that were used.
    """

    serial: str
    turn_rad: Triple
    displacement_m: Triple
    covariance: list[list[float]]


def imu_place_parts(calibration: ImuCalibration) -> list[ImuPlacePart]:
    """Return the places of IMUs as parts, in their order."""
    return [
        ImuPlacePart(
            serial=serial,
            turn_rad=triple(calibration.placement[k, :3]),
            displacement_m=triple(calibration.placement[k, 3:]),
            covariance=calibration.placement_covariance(k).tolist(),
        )
        for k, serial in enumerate(calibration.serials)
    ]


def base_parameter_parts(base: BaseParameters) -> list[BaseParameterPart]:
    """Return all base parameters as parts, in their order."""
    return [
        BaseParameterPart(
            summary=base.summary(i),
            value=float(base.value[i]),
            sigma=float(base.sigma[i]),
            relative_sigma=finite(float(base.relative_sigma[i])),
        )
        for i in range(base.rank)
    ]


def body_part(body: Body) -> BodyPart:
    """Return a body as a part."""
    return BodyPart(
        mass_kg=body.mass_kg, com_m=body.com_m.tolist(), inertia_kg_m2=body.inertia_kg_m2.tolist()
    )


def finite(value: float) -> float | None:
    """Return a number, or None for what JSON does not have: NaN and infinity."""
    return value if np.isfinite(value) else None


def triple(values: Array) -> Triple:
    """Return the three elements of an array."""
    x, y, z = values.tolist()
    return x, y, z
