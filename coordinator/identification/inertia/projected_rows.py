"""Append signals as columns to rows that an agent has already gathered.

Of the rows A of a joint and its torques only the factor R of A = Q R and z = Q^T tau are known. The
projection Q^T c of another signal c of the same samples solves R^T x = A^T c.
"""

import numpy as np

from module_agent.model.chain import Array
from module_agent.model.information import JointInformation

# Directions with a smaller share of the rows are rounding; no fit uses them.
_ROUNDING = 1e-10


class ProjectedRows:
    """The information of one joint in p columns; signals of its samples are added stretch by stretch."""

    def __init__(self, gathered: JointInformation) -> None:
        self._gathered = gathered
        self._departure: Array = np.zeros(gathered.r.shape[1])
        self._effects: Array | None = None
        self._shared = 0.0

    def add(self, rows: Array, torque_nm: Array, departure_nm: Array, effects_nm: Array) -> None:
        """Add a stretch of samples.

        Args:
            rows: (m, p), those of which `gathered` is the factor.
            torque_nm: (m,) gathered with them.
            departure_nm: (m,) to be subtracted from the torques.
            effects_nm: (m, k) to be appended to the rows.
        """
        self._departure = self._departure + rows.T @ departure_nm
        products = rows.T @ effects_nm
        self._effects = products if self._effects is None else self._effects + products
        self._shared += float(departure_nm @ (departure_nm - 2.0 * torque_nm))

    def rows(self) -> JointInformation:
        """Return the information in p + k columns, of the torques less the departures."""
        r, z = self._gathered.r, self._gathered.z
        effects = np.zeros((r.shape[1], 0)) if self._effects is None else self._effects
        appended = self._projected(np.column_stack([self._departure, effects]))
        left = z - appended[:, 0]
        size = float(z @ z) + self._gathered.rest + self._shared
        return self._gathered._replace(
            r=np.hstack([r, appended[:, 1:]]), z=left, rest=max(size - float(left @ left), 0.0)
        )

    def _projected(self, products: Array) -> Array:
        """Return the smallest x with R^T x = products."""
        # Columns of one size, so that the singular values compare.
        size = np.linalg.norm(self._gathered.r, axis=0)
        scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
        left, values, right = np.linalg.svd(self._gathered.r * scale, full_matrices=False)
        kept = values > _ROUNDING * values[0]
        solution = right[kept] @ (scale[:, None] * products) / values[kept, None]
        return np.asarray(left[:, kept] @ solution)
