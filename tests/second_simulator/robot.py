"""Random rigid robots of X5 modules as models of pinocchio, with the truth that a result is compared with.

Nothing here is shared with the package but the published convention (docs/theory.md): the pose of a module's
mounting face in the face that its parent moves. A forward module is mounted by its housing, and turns its
output by q about the housing's z; a reversed one is mounted by its output, and turns its housing by -q.
"""

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# The manufacturer's drawing of an X5: output and IMU in the housing's frame [m], masses [kg].
OUTPUT_M, IMU_M = np.array([0.0, 0.0, 0.03105]), np.array([0.025, 0.0, 0.003])
MASS_KG = {"X5-1": 0.315, "X5-4": 0.335, "X5-9": 0.360}
CENTRE_M = np.array([-0.0142, -0.0031, 0.0165])
FLANGE_KG = 0.03
# How an IMU differs from the drawing: place and turn in the housing, one standard deviation an axis.
PLACE_M, TURN_RAD = 1e-3, np.radians(0.12)
MIN_MODULES, MAX_MODULES = 2, 6
FLIP = pin.SE3(Rotation.from_euler("x", np.pi).as_matrix(), np.zeros(3))


class Robot(NamedTuple):
    """A robot of n modules; a parent comes before its children, -1 is the base.

    model: joint k + 1 of pinocchio's is that of module k. imus: (n,) its frames of the IMUs.
    moved, mounting: (n,) each module's moved and mounting face in the frame of its own joint at q = 0.
    nominal_imu: (n,) where the drawing has the IMUs, in the frames of their own joints at q = 0.
    """

    serials: tuple[str, ...]
    types: tuple[str, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    model: Any
    imus: tuple[int, ...]
    moved: tuple[Any, ...]
    mounting: tuple[Any, ...]
    nominal_imu: tuple[Any, ...]

    @property
    def joints_home(self) -> list[Any]:
        """The placements of all joints in the world at q = 0."""
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        return [data.oMi[k + 1].copy() for k in range(len(self.serials))]

    def link(self, child: int) -> tuple[Array, Array]:
        """Return the true pose of a child's mounting face in its parent's moved face: rotation, place."""
        home, parent = self.joints_home, self.parent[child]
        pose = (home[parent] * self.moved[parent]).actInv(home[child] * self.mounting[child])
        return np.array(pose.rotation), np.array(pose.translation)

    def link_length_m(self, child: int) -> float:
        """Return the true distance from the parent's axis to where the drawing has the child's IMU."""
        home, parent = self.joints_home, self.parent[child]
        imu = home[parent].actInv(home[child] * self.nominal_imu[child]).translation
        return float(np.hypot(imu[0], imu[1]))


def random_robot(seed: int, modules: int | None = None) -> Robot:
    """Draw a robot: chain or tree, links of 5 to 30 cm, on a level base or a wall, nearly."""
    rng = np.random.default_rng([seed, 1])
    count = int(rng.integers(MIN_MODULES, MAX_MODULES + 1)) if modules is None else modules
    straight = bool(rng.random() < 0.5)
    parents = [-1] + [k - 1 if straight else int(rng.integers(0, k)) for k in range(1, count)]
    serials = tuple(f"P-{number:04d}" for number in rng.choice(10_000, count, replace=False))
    types = tuple(str(name) for name in rng.choice(sorted(MASS_KG), count))
    backwards = tuple(bool(one) for one in rng.random(count) < 0.3)
    return _built(rng, serials, types, tuple(parents), backwards)


def _built(
    rng: np.random.Generator,
    serials: tuple[str, ...],
    types: tuple[str, ...],
    parents: tuple[int, ...],
    backwards: tuple[bool, ...],
) -> Robot:
    model = pin.Model()
    # Local gravity: anywhere on the ground of the Earth.
    model.gravity.linear = np.array([0.0, 0.0, -float(rng.uniform(9.764, 9.834))])
    to_output = pin.SE3(np.eye(3), OUTPUT_M)
    imus, moved, mounting, nominal = [], [], [], []
    for k, (kind, parent, back) in enumerate(zip(types, parents, backwards, strict=True)):
        face = pin.SE3.Identity() if parent < 0 else moved[parent]
        link = _base(rng) if parent < 0 else _link(rng)
        placement = face * link * (FLIP if back else to_output)
        joint = model.addJoint(parent + 1, pin.JointModelRZ(), placement, f"joint {k}")
        # In the frame of the own joint at q = 0.
        output = FLIP if back else pin.SE3.Identity()
        housing = output * to_output.inverse()
        moved.append(housing if back else output)
        mounting.append(output if back else housing)
        nominal.append(housing * pin.SE3(np.eye(3), IMU_M))
        turn = Rotation.from_rotvec(rng.normal(0.0, TURN_RAD, 3)).as_matrix()
        imu = nominal[-1] * pin.SE3(turn, rng.normal(0.0, PLACE_M, 3))
        # What the joint turns is fixed to it, the other half of the module to the parent.
        carrier, there = (joint, imu) if back else (parent + 1, placement * imu)
        imus.append(model.addFrame(pin.Frame(f"imu {k}", carrier, there, pin.FrameType.SENSOR)))
        held = placement * mounting[-1]
        block, disc = _halves(MASS_KG[kind])
        model.appendBodyToJoint(joint, *((block, housing) if back else (disc, output)))
        model.appendBodyToJoint(parent + 1, *((disc, held) if back else (block, held)))
        if parent >= 0:
            reach = np.linalg.norm(link.translation)
            tube = pin.Inertia(0.3 * reach + 0.05, 0.5 * link.translation, 0.02 * reach**2 * np.eye(3))
            model.appendBodyToJoint(parent + 1, tube, face)
    return Robot(
        serials, types, parents, backwards, model, tuple(imus), tuple(moved), tuple(mounting), tuple(nominal)
    )


def _halves(mass_kg: float) -> tuple[Any, Any]:
    """Return a module's housing and its output's flange, each in its own frame."""
    block = pin.Inertia(mass_kg - FLANGE_KG, CENTRE_M, np.diag([1.5e-4, 2.6e-4, 3.5e-4]))
    disc = pin.Inertia(FLANGE_KG, np.array([0.0, 0.0, -0.003]), np.diag([2.5e-6, 2.5e-6, 4.9e-6]))
    return block, disc


def _base(rng: np.random.Generator) -> Any:
    """Draw a base: level or a wall, with any heading, a degree off, as no robot is mounted exactly."""
    upright = Rotation.from_euler("x", rng.choice([0.0, np.pi / 2.0]))
    off = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.0), 3))
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * off * upright
    return pin.SE3(turn.as_matrix(), np.zeros(3))


def _link(rng: np.random.Generator) -> Any:
    """Draw a link: right angles as of a kit's brackets, or any turn; any direction, 5 to 30 cm long."""
    if rng.random() < 0.5:
        about, tilt = rng.choice([0.0, 0.5, 1.0, 1.5]), rng.choice([0.0, 0.5, -0.5])
        turn = Rotation.from_euler("zx", [np.pi * float(about), np.pi * float(tilt)])
    else:
        turn = Rotation.random(rng=rng)
    direction = rng.normal(size=3)
    place = rng.uniform(0.05, 0.3) * direction / np.linalg.norm(direction)
    return pin.SE3(turn.as_matrix(), place)
