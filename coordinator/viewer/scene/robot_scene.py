"""The robot in 3D: housings, outputs, links, joint axes and IMU frames, each under the body that moves it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from coordinator.description.module_geometry import LINK_RADIUS_M, Link, Module, from_z, links
from coordinator.viewer.scene import entity_paths
from coordinator.viewer.scene.robot_geometry import modules, upright
from coordinator.viewer.scene.time_series import IntArray, time_column
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.perturbation import skew

OUTPUT_RADIUS_M = 0.024
OUTPUT_THICKNESS_M = 0.008
AXIS_LENGTH_M = 0.09
IMU_AXIS_LENGTH_M = 0.05
MAX_LONG_LABELS = 4
# A normally distributed point is in this ellipsoid with 95 %: the root of chi^2 of three degrees of freedom.
ELLIPSOID_SIGMAS = 2.7955

Drawn = rr.AsComponents


class SceneStyle(NamedTuple):
    """How a robot is drawn in one world: colour of the links, and one `uniform` colour of the rest, if any.

    The truth is translucent and without labels, so that it does not hide the estimate, which should coincide
    with it.
    """

    world: str
    link: entity_paths.Colour
    uniform: entity_paths.Colour | None
    fill: rr.components.FillMode
    labels: bool


ESTIMATE_STYLE = SceneStyle(
    entity_paths.ESTIMATED_WORLD,
    entity_paths.ESTIMATE_COLOUR,
    None,
    rr.components.FillMode.Solid,
    labels=True,
)
TRUTH_STYLE = SceneStyle(
    entity_paths.TRUE_WORLD,
    entity_paths.TRUE_BODY_COLOUR,
    entity_paths.TRUE_BODY_COLOUR,
    rr.components.FillMode.TransparentFillMajorWireframe,
    labels=False,
)


class Scene(NamedTuple):
    """Everything that is logged of a chain: (entity path, archetypes), in the root frame at q = 0."""

    chain: Chain
    style: SceneStyle
    drawn: tuple[tuple[str, tuple[Drawn, ...]], ...]


def build_scene(
    chain: Chain,
    types: Mapping[str, str],
    colours: Mapping[str, entity_paths.Colour],
    sigma_m: Sequence[float] | None = None,
    style: SceneStyle = ESTIMATE_STYLE,
    covariance: Array | None = None,
) -> Scene:
    """Draw a chain at q = 0.

    Args:
        chain: n joints.
        types: module type's name by serial.
        colours: the modules' colours by serial.
        sigma_m: (n,) standard deviation of the link to each joint [m]; not finite if unknown.
        style: world and colours.
        covariance: (6 n, 6 n) of the chain's perturbations, for ellipsoids that hold the joints with 95 %.

    Raises:
        KeyError: a serial has no type or colour.
        ValueError: `sigma_m` has not one value per joint, or gravity has no direction.
    """
    if sigma_m is not None and len(sigma_m) != len(chain.serials):
        raise ValueError(f"{len(sigma_m)} sigmas for a chain of {len(chain.serials)} joints")
    paint = [style.uniform or colours[serial] for serial in chain.serials]
    painter = _Painter(chain, modules(chain, types), paint, sigma_m, style, covariance)
    vertical = rr.Transform3D(quaternion=_quaternion(upright(chain.gravity)))
    drawn: list[tuple[str, tuple[Drawn, ...]]] = [(style.world, (vertical,))]
    for body in range(BASE, len(chain.serials)):
        drawn += painter.body(body)
    return Scene(chain, style, tuple(drawn))


def log_scene(stream: rr.RecordingStream, scene: Scene, q_rad: Array, before: Scene | None) -> None:
    """Log a scene in the posture `q_rad` (n,), at the stream's time, in place of the one before."""
    retained = {path for path, _ in scene.drawn}
    for path, _ in before.drawn if before is not None else ():
        if path not in retained:
            stream.log(path, rr.Clear(recursive=False))
    for path, archetypes in scene.drawn:
        for archetype in archetypes:
            stream.log(path, archetype)
    displaced = body_displacements(scene.chain, q_rad[None, :])[0]
    for serial, motion in zip(scene.chain.serials, displaced, strict=True):
        path = entity_paths.body_path(scene.style.world, serial)
        stream.log(path, rr.Transform3D(translation=motion[:3, 3], mat3x3=motion[:3, :3]))


def send_poses(stream: rr.RecordingStream, scene: Scene, t_ns: IntArray, q_rad: Array) -> None:
    """Turn the robot to `q_rad` (k, n) at `t_ns` (k,): one column of transforms per body.

    Raises:
        ValueError: `q_rad` has not one position per joint.
    """
    displaced = body_displacements(scene.chain, q_rad)
    for body, serial in enumerate(scene.chain.serials):
        moved = rr.Transform3D.columns(
            translation=displaced[:, body, :3, 3], mat3x3=displaced[:, body, :3, :3]
        )
        stream.send_columns(entity_paths.body_path(scene.style.world, serial), [time_column(t_ns)], moved)


def gravity_arrow(chain: Chain, radius_m: float) -> rr.Arrows3D:
    """Return gravity as an arrow next to the robot, in the upright world."""
    length = 0.3 * max(radius_m, 0.2)
    strength = float(np.linalg.norm(chain.gravity))
    return rr.Arrows3D(
        origins=[[-length, -0.4 * length, 1.4 * length]],
        vectors=[[0.0, 0.0, -length]],
        radii=0.008,
        colors=[(200, 200, 210, 255)],
        labels=[f"gravity {strength:.2f} m/s²"],
        show_labels=True,
    )


class _Painter(NamedTuple):
    """A chain with its geometry, and how it is drawn; `paint` are the modules' colours."""

    chain: Chain
    placed: tuple[Module, ...]
    paint: Sequence[entity_paths.Colour]
    sigma_m: Sequence[float] | None
    style: SceneStyle
    covariance: Array | None

    def body(self, body: int) -> list[tuple[str, tuple[Drawn, ...]]]:
        """Draw what a body carries."""
        chain, placed, style = self.chain, self.placed, self.style
        path = entity_paths.body_path(style.world, None if body == BASE else chain.serials[body])
        housed = [k for k, module in enumerate(placed) if module.housing_body == body]
        drawn: list[tuple[str, tuple[Drawn, ...]]] = []
        if housed:
            drawn.append((f"{path}/housing", (self._housings(housed),)))
            if style.uniform is None:
                names = [entity_paths.part(chain.serials[k]) for k in housed]
                drawn += [(f"{path}/imu/{name}", self._imu(k)) for name, k in zip(names, housed, strict=True)]
        turning = [k for k, module in enumerate(placed) if module.output_body == body]
        if turning:
            drawn.append((f"{path}/output", (self._outputs(turning),)))
        if body != BASE:
            drawn.append((f"{path}/axis", (self._axis(body),)))
            unknown = self.sigma_m is not None and not np.isfinite(self.sigma_m[body])
            if self.covariance is not None and not unknown:
                drawn.append((f"{path}/spread", (self._spread(body, self.covariance),)))
        joined = [link for link in links(chain, placed) if link.body == body and link.length_m > 1e-4]
        # The base is at the first module of the identified robot; the truth may be drawn elsewhere.
        if joined and not (body == BASE and style.uniform is not None):
            drawn.append((f"{path}/link", (self._links(joined),)))
        return drawn

    def _housings(self, housed: Sequence[int]) -> rr.Boxes3D:
        carried = [self.placed[k] for k in housed]
        return rr.Boxes3D(
            sizes=[each.box_size for each in carried],
            centers=[each.housing[:3, :3] @ each.box_centre + each.housing[:3, 3] for each in carried],
            quaternions=[_quaternion(Rotation.from_matrix(each.housing[:3, :3])) for each in carried],
            colors=[self.paint[k] for k in housed],
            fill_mode=self.style.fill,
            labels=[self._label(k) for k in housed],
            show_labels=self.style.labels,
        )

    def _label(self, k: int) -> str:
        name = self.chain.serials[k] + (" (reversed)" if self.chain.reversed[k] else "")
        # The root is the reference of the others; of many modules the labels would hide the robot.
        if self.sigma_m is None or self.sigma_m[k] == 0.0 or len(self.placed) > MAX_LONG_LABELS:
            return name
        if not np.isfinite(self.sigma_m[k]):
            return f"{name}  position unknown"
        return f"{name}  ±{1e3 * self.sigma_m[k]:.2g} mm"

    def _outputs(self, turning: Sequence[int]) -> rr.Cylinders3D:
        return rr.Cylinders3D(
            lengths=[OUTPUT_THICKNESS_M] * len(turning),
            radii=[OUTPUT_RADIUS_M] * len(turning),
            centers=[self.placed[k].output for k in turning],
            quaternions=[_quaternion(from_z(self.placed[k].axis)) for k in turning],
            colors=[entity_paths.shade(self.paint[k], 0.5) for k in turning],
            fill_mode=self.style.fill,
        )

    def _axis(self, k: int) -> rr.Arrows3D:
        return rr.Arrows3D(
            origins=[self.placed[k].output],
            vectors=[AXIS_LENGTH_M * self.placed[k].axis],
            radii=0.004,
            colors=[entity_paths.shade(self.paint[k], 1.4)],
        )

    def _spread(self, k: int, covariance: Array) -> rr.Ellipsoids3D:
        """Draw where the joint may be, as the covariance of its twist (w, v) moves it: w x p + v."""
        own, place = slice(6 * k, 6 * k + 6), self.placed[k].output
        slope = np.hstack([-skew(place), np.eye(3)])
        variances, axes = np.linalg.eigh(slope @ covariance[own, own] @ slope.T)
        # Eigenvectors may be left-handed; an ellipsoid is the same with one of its axes turned about.
        axes[:, 2] *= np.linalg.det(axes)
        return rr.Ellipsoids3D(
            centers=[place],
            half_sizes=[ELLIPSOID_SIGMAS * np.sqrt(np.maximum(variances, 0.0))],
            quaternions=[_quaternion(Rotation.from_matrix(axes))],
            colors=[self.style.link],
            fill_mode="transparentfillmajorwireframe",
        )

    def _links(self, joined: Sequence[Link]) -> rr.Cylinders3D:
        """Draw links as the tubes that the URDF has: what they truly look like is not identified."""
        return rr.Cylinders3D(
            lengths=[link.length_m for link in joined],
            radii=[LINK_RADIUS_M] * len(joined),
            centers=[0.5 * (link.start + link.end) for link in joined],
            quaternions=[_quaternion(from_z((link.end - link.start) / link.length_m)) for link in joined],
            colors=[self.style.link] * len(joined),
            fill_mode=self.style.fill,
        )

    def _imu(self, k: int) -> tuple[Drawn, ...]:
        pose = self.chain.imu_home[k]
        return (
            rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]),
            rr.TransformAxes3D(axis_length=IMU_AXIS_LENGTH_M),
        )


def _quaternion(rotation: Rotation) -> rr.Quaternion:
    return rr.Quaternion(xyzw=rotation.as_quat())
