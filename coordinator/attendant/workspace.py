"""The space that a person gives a robot, and the gate that holds every motion to it and clear of the robot.

The whole path of a motion is sampled and checked before any of it is commanded: the joints against their
ranges, the links' axes with a margin against the box, and the links against each other as the design of
motions does (`self_collision`). A robot that stands outside, for example limp, may come in, get no further
out, and return to where it stood, so that it does not fall when its motors are off. Of modules whose place is
not known only the joints' ranges and how far they can reach are.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from coordinator.description.urdf_writer import upright_pose
from coordinator.excitation.plan import Plan
from coordinator.excitation.self_collision import CLEARANCE_M, clearance_m, link_axes
from coordinator.live_robot.errors import MotionForbidden
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import UsageError
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.model_faults import faults_of, first_fault
from module_agent.model.toml_location import fault_lines, read_toml
from module_agent.wire.messages import ConstantMotion, GoTo, Pattern

# Half an X5's housing, with cables.
BODY_M = 0.06
# A module and the longest tube that is sold, stretched out: so far a module may be from what is known.
MODULE_REACH_M = 0.5
# The path is sampled so often; at 2 rad/s and 0.5 m reach that is every 2 cm.
RATE_HZ = 50.0
MAX_SAMPLES = 6000
# Rounding, and how far held joints give.
SLACK_RAD, SLACK_M = 0.03, 0.01
# Less room to either side of home does not show where a module is.
MIN_ROOM_RAD = 0.3

Triple = tuple[float, float, float]
Range = tuple[float, float]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(_Table):
    """A box in the frame `world` of robot.urdf: z up, the origin at the root frame's [m]."""

    low_m: Triple
    high_m: Triple

    @model_validator(mode="after")
    def _extends(self) -> Self:
        if any(low >= high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(f"low_m {self.low_m} must be below high_m {self.high_m} along every axis")
        return self


class Workspace(_Table):
    """What a robot may use. joints: ranges [rad] by serial, `all` of those that have none of their own.

    tool_m: how far something reaches beyond the last modules. trial_speed_rad_s: how fast it begins.
    """

    box: Box
    joints: dict[str, Range]
    tool_m: Annotated[float, Field(ge=0.0, le=2.0)] = 0.1
    trial_speed_rad_s: Annotated[float, Field(gt=0.0, le=1.0)] = 0.3

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        if "all" not in self.joints:
            raise ValueError("joints.all is missing: the range of every joint without one of its own")
        for name, (low, high) in self.joints.items():
            if not low < high:
                raise ValueError(f"joints.{name} = [{low}, {high}]: the first must be below the second")
        return self

    def range_rad(self, serial: str) -> Range:
        """Return the range of a joint."""
        return self.joints.get(serial, self.joints["all"])

    def check_joints(self, serials: Collection[str]) -> None:
        """Check that every range is one of a module of the robot: another joint's would not hold.

        Raises:
            UsageError: one is of no module.
        """
        unknown = [name for name in self.joints if name != "all" and name not in serials]
        if unknown:
            raise UsageError(
                f"the workspace has ranges of {', '.join(unknown)}, which the robot does not have: its "
                f"joints are named by the serials of their modules, {', '.join(sorted(serials))}"
            )

    def plan(self, plan: Plan, serials: Sequence[str]) -> Plan:
        """Return a plan whose motions about home have the room that the joints have; it begins slowly.

        Raises:
            UsageError: a joint has too little room about home, for this plan or for any.
        """
        home, room = plan.home_rad, np.inf
        for serial in serials:
            low, high = self.range_rad(serial)
            room = min(room, home - low, high - home)
            if room < MIN_ROOM_RAD:
                raise UsageError(
                    f"the workspace leaves joint {serial} {low:g} to {high:g} rad: at least "
                    f"{MIN_ROOM_RAD} rad to either side of home, {home:g} rad, are needed to measure it"
                )
        ramp_s = ConstantMotion(velocity_rad_s=1.0, duration_s=1.0).ramp_s
        longest_s = 2.0 * (room - SLACK_RAD) / plan.constant_velocity_rad_s - ramp_s
        changed = {
            "constant_duration_s": min(plan.constant_duration_s, longest_s),
            "excitation_reach_rad": min(plan.excitation_reach_rad, room),
            "trial_speed_rad_s": self.trial_speed_rad_s,
        }
        try:
            return Plan.model_validate({**plan.model_dump(), **changed})
        except ValidationError as error:
            raise UsageError(
                f"no plan fits into the workspace, {room:g} rad to either side of home: {first_fault(error)}"
            ) from error


def load_workspace(path: Path) -> Workspace:
    """Read a workspace from a TOML file.

    Raises:
        UsageError: the file cannot be read, is not TOML, or is no workspace; the message names the key.
    """
    table, text = read_toml(path)
    try:
        return Workspace.model_validate(table)
    except ValidationError as error:
        raise UsageError(fault_lines(faults_of(error), text, path)) from error


class _Body(NamedTuple):
    """Points (k, 3) at q = 0 in the root frame that must stay in the box, their bodies and margins (k,)."""

    body: NDArray[np.int64]
    point: Array
    margin_m: Array


class WorkspaceGate:
    """Holds a robot to a workspace.

    Args:
        workspace: what it may use.
        chain: the robot as it is known.
        home_rad: where all joints stand clear of each other.
        present: serials of the modules that are there now, known or not.

    Raises:
        MotionForbidden: not even the first module is known, so that it is not known where the robot is.
    """

    def __init__(self, workspace: Workspace, chain: Chain, home_rad: float, present: Collection[str]):
        self._workspace = workspace
        self._home_rad = home_rad
        self._began_rad: Mapping[str, float] | None = None
        placed = _still_placed(chain, present)
        if not placed:
            raise MotionForbidden(
                "no module that stands on the base is a known one, so that it is not known where the robot "
                "is in its workspace: identify it with x5-coordinator run"
            )
        unknown = len([s for s in present if s not in {chain.serials[k] for k in placed}])
        self._take(chain, placed, unknown)

    def learn(self, chain: Chain) -> None:
        """Take in the robot as it was explored: the place of every module is known now."""
        self._take(chain, range(len(chain.serials)), 0)

    def _take(self, chain: Chain, placed: Collection[int], unknown: int) -> None:
        self._chain = chain
        self._unknown = unknown
        axes = link_axes(chain)
        kept = np.isin(axes.body, list(placed))
        body, ends = np.repeat(axes.body[kept], 2), axes.ends[kept].reshape(-1, 3)
        carrying = {chain.parent[k] for k in placed}
        tips = np.array([k not in carrying for k in body])
        margin = np.where(tips, BODY_M + self._workspace.tool_m, BODY_M) + MODULE_REACH_M * unknown
        self._body = _Body(body, ends, margin)

    def admit(self, patterns: Mapping[str, Pattern], at_rad: Mapping[str, float]) -> None:
        """Let motions pass that begin together at positions of all joints.

        Raises:
            MotionForbidden: they would leave the workspace, or come too near to the robot itself.
        """
        if self._began_rad is None:
            self._began_rad = dict(at_rad)
        returns = all(_goes_to(pattern, self._began_rad.get(s)) for s, pattern in patterns.items())
        before = [at_rad, self._began_rad] if returns else [at_rad]
        paths = _paths(patterns, at_rad)
        for serial, path in paths.items():
            low, high = self._workspace.range_rad(serial)
            stood = [at[serial] for at in before if serial in at]
            self._forbid_beyond(serial, path, min([low, *stood]), max([high, *stood]))
        still = next(iter(paths.values()))
        q = np.stack(
            [paths.get(s, np.full(len(still), at_rad.get(s, self._home_rad))) for s in self._chain.serials],
            axis=1,
        )
        stood_rad = np.array([[at.get(s, self._home_rad) for s in self._chain.serials] for at in before])
        out, where = self._outside_m(q, stood_rad)
        if where is not None:
            raise MotionForbidden(
                f"the motion of {', '.join(patterns)} would bring {where} {out:.2f} m out of the box of the "
                "workspace; nothing was commanded"
            )
        spare = self._clearance_m(q) - CLEARANCE_M
        if spare.min() < min(0.0, (self._clearance_m(stood_rad) - CLEARANCE_M).min()) - SLACK_M:
            raise MotionForbidden(
                f"the motion of {', '.join(patterns)} would bring links of the robot nearer to each other "
                f"than {CLEARANCE_M:.2f} m; nothing was commanded"
            )

    def allows(self, q_rad: Array) -> bool:
        """Return whether the robot may be at positions (m, n) on its way from home and back."""
        for serial, path in zip(self._chain.serials, q_rad.T, strict=True):
            low, high = self._workspace.range_rad(serial)
            if path.min() < low or path.max() > high:
                return False
        home = np.full((1, q_rad.shape[1]), self._home_rad)
        return self._outside_m(q_rad, home)[1] is None

    @staticmethod
    def _forbid_beyond(serial: str, path: Array, low: float, high: float) -> None:
        if path.min() < low - SLACK_RAD or path.max() > high + SLACK_RAD:
            worst = path.min() if path.min() < low - SLACK_RAD else path.max()
            raise MotionForbidden(
                f"joint {serial} would go to {worst:.2f} rad; the workspace leaves it {low:.2f} to "
                f"{high:.2f} rad; nothing was commanded"
            )

    def _outside_m(self, q_rad: Array, before_rad: Array) -> tuple[float, str | None]:
        """Return how far and what leaves the box at positions (m, n), None if nothing does.

        What is outside before, at one of the positions (b, n), may be so, and no further.
        """
        out, before = self._beyond_m(q_rad), self._beyond_m(before_rad)
        excess = out - np.maximum(before.max(axis=0), 0.0)
        worst = int(np.argmax(excess.max(axis=0)))
        if excess[:, worst].max() <= SLACK_M:
            return 0.0, None
        name = f"the body that {self._chain.serials[int(self._body.body[worst])]} turns"
        if self._unknown:
            name += ", or a module whose place is unknown,"
        return float(out[:, worst].max()), name

    def _beyond_m(self, q_rad: Array) -> Array:
        """Return how far the points are beyond the box at positions (m, n): (m, k), negative within."""
        upright = upright_pose(self._chain.gravity)[:3, :3]
        moved = body_displacements(self._chain, q_rad)[:, self._body.body]
        places = np.einsum("mkij,kj->mki", moved[..., :3, :3], self._body.point) + moved[..., :3, 3]
        places = places @ upright.T
        margin = self._body.margin_m[:, None]
        box = self._workspace.box
        beyond = np.maximum(np.array(box.low_m) - places + margin, places + margin - np.array(box.high_m))
        return np.asarray(beyond.max(axis=2))

    def _clearance_m(self, q_rad: Array) -> Array:
        home = np.full(len(self._chain.serials), self._home_rad)
        near = clearance_m(self._chain, q_rad, home)
        # Without a pair that can collide it is infinite.
        return np.where(np.isfinite(near), near, CLEARANCE_M)


def _still_placed(chain: Chain, present: Collection[str]) -> list[int]:
    """Return the modules whose place is known: they and all that carry them are there."""
    placed: list[int] = []
    for k, (serial, parent) in enumerate(zip(chain.serials, chain.parent, strict=True)):
        if serial in present and (parent == BASE or parent in placed):
            placed.append(k)
    return placed


def _goes_to(pattern: Pattern, target_rad: float | None) -> bool:
    return (
        isinstance(pattern, GoTo)
        and target_rad is not None
        and abs(pattern.target_rad - target_rad) < SLACK_RAD
    )


def _paths(patterns: Mapping[str, Pattern], at_rad: Mapping[str, float]) -> dict[str, Array]:
    """Return the positions (m,) of the joints that move, at the same times."""
    lasting = {s: duration_s(pattern, at_rad.get(s, 0.0)) for s, pattern in patterns.items()}
    longest = max(lasting.values())
    t_s = np.linspace(0.0, longest, min(int(longest * RATE_HZ) + 2, MAX_SAMPLES))
    return {
        s: at_rad.get(s, 0.0) + waveform(pattern, at_rad.get(s, 0.0), np.minimum(t_s, lasting[s])).offset_rad
        for s, pattern in patterns.items()
    }
