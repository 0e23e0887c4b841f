"""What a module makes of another joint's motion, from its own rows and the joint's, on two clocks."""

from typing import Any

import numpy as np
import pytest

from module_agent.estimate.observer import Finding, Observer
from module_agent.firmware.feedback import History
from module_agent.peers.motion_listener import MAX_MODULES, JointMotion
from module_agent.wire.feedback_rows import ROW, Rows
from module_agent.wire.messages import ConstantMotion, MotionRecord, Pattern, Rest, WindowedSine

CONSTANT = ConstantMotion(velocity_rad_s=1.0, duration_s=0.75)
SINE = WindowedSine(amplitude=0.1)
AHEAD_S = 37.5  # the own clock shows this much more than the joint's
ROUGH_NS = round(AHEAD_S * 1e9) + 12_000_000  # too large by the delay of the network


def _record(motion_id: int, pattern: Pattern, start: int, end: int | None) -> MotionRecord:
    return MotionRecord(
        motion_id=motion_id,
        pattern=pattern,
        outcome="done",
        start_ns=0,
        start_row=start,
        end_row=end,
        origin_rad=0.0,
    )


def _values(row: Any) -> tuple[float, ...]:
    return tuple(value for field in row.item() for value in np.ravel(field).tolist())


class Scene:
    """A module that rests and then is carried by the joint `J` through both exploration motions."""

    def __init__(self, hinge: Any, seed: int = 0, history_rows: int = 15_000):
        rng = np.random.default_rng(seed)
        self.history = History(history_rows)
        rest = hinge.rest(rng)
        self._append(rest, 0)
        self.rest = _record(1, Rest(duration_s=2.0), 0, self.history.next_row)
        self.motions: dict[str, JointMotion] = {}
        for number, (name, pattern) in enumerate((("constant", CONSTANT), ("sine", SINE))):
            windows = hinge.constant(1.0, seed) if name == "constant" else hinge.sine(0.1, seed)
            shift = (10 + 20 * number) * 10**9
            self._append(windows[0], shift + round(AHEAD_S * 1e9))
            rows = self._joint_rows(windows[1], shift)
            self.motions[name] = JointMotion(
                "J", 5, _record(10 + number, pattern, 0, len(rows)), rows, {"ME": ROUGH_NS}
            )

    def _append(self, imu: Any, shift_ns: int) -> None:
        rows = np.zeros(len(imu.t_ns), dtype=ROW)
        rows["t_ns"] = rows["imu_t_ns"] = imu.t_ns + shift_ns
        rows["gyro_rad_s"], rows["accel_m_s2"] = imu.gyro_rad_s, imu.accel_m_s2
        for row in rows:
            self.history.append(_values(row))

    @staticmethod
    def _joint_rows(joint: Any, shift_ns: int) -> Rows:
        rows = np.zeros(len(joint.t_ns), dtype=ROW)
        rows["t_ns"] = rows["imu_t_ns"] = joint.t_ns + shift_ns
        rows["position_rad"], rows["velocity_rad_s"] = joint.position_rad, joint.velocity_rad_s
        return rows

    def observe(self, observer: Observer, name: str, rest: bool = True) -> Any:
        return observer.job(self.motions[name], self.history, self.rest if rest else None)()


@pytest.fixture
def observer() -> Observer:
    return Observer("ME", 9)


@pytest.mark.parametrize("seed", range(3))
def test_the_circle_of_another_joint_is_found_in_the_own_frame(
    horizontal_link: Any, observer: Observer, seed: int
) -> None:
    scene = Scene(horizontal_link, seed)
    first = scene.observe(observer, "constant")
    found = scene.observe(observer, "sine")
    assert first.moved
    assert first.circle is None
    assert found.moved
    assert found.note == ""
    assert found.motion_ids == (10, 11)
    assert found.rate_ratio == pytest.approx(1.0, abs=0.01)
    circle = found.circle
    assert circle is not None
    # Noise gives 0.01 deg and 0.3 mm, the smoothing of the sine makes 245 mm 0.8 % too long.
    assert np.degrees(np.arccos(min(1.0, np.dot(circle.axis, horizontal_link.axis)))) < 0.2
    np.testing.assert_allclose(circle.radial_m, horizontal_link.radial, atol=3e-3)
    assert abs(circle.distance_m - 0.245) < 3e-3
    # The rough offset was too large by the network's 12 ms, which the motion itself tells.
    assert circle.delay_s == pytest.approx(-12e-3, abs=1e-3)
    np.testing.assert_allclose(found.gravity_m_s2, horizontal_link.gravity, atol=0.02)


def test_a_module_that_is_not_carried_says_so(horizontal_link: Any, observer: Observer) -> None:
    scene = Scene(horizontal_link._replace(carried=0.2))
    found = [scene.observe(observer, name) for name in ("constant", "sine")]
    assert [f.moved for f in found] == [False, False]
    assert found[1].circle is None
    # The give of the joints between shows as it is.
    assert found[1].rate_ratio == pytest.approx(0.2, abs=0.02)


def test_without_a_constant_motion_the_axis_is_not_known_and_that_is_said(
    horizontal_link: Any, observer: Observer
) -> None:
    found = Scene(horizontal_link).observe(observer, "sine")
    assert found.moved
    assert found.circle is None
    assert found.note == "no constant motion of J was seen: its axis is not known"


def test_the_constant_motion_of_an_earlier_boot_is_not_used(horizontal_link: Any, observer: Observer) -> None:
    scene = Scene(horizontal_link)
    scene.observe(observer, "constant")
    scene.motions["sine"] = scene.motions["sine"]._replace(boot=6)
    assert "no constant motion" in scene.observe(observer, "sine").note


def test_joints_that_were_made_up_do_not_fill_the_memory_and_the_latest_one_is_measured(
    horizontal_link: Any, observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(horizontal_link)
    rows = len(scene.motions["constant"].rows)
    monkeypatch.setattr("module_agent.estimate.observer.MAX_CONSTANT_ROWS", 10 * rows + 1)
    for number in range(30):
        of_joint = scene.motions["constant"]._replace(serial=f"M{number}")
        assert observer.job(of_joint, scene.history, scene.rest)().moved
    kept = sum(len(each.windows.joint.t_ns) for each in observer._constant.values())
    assert 9 * rows <= kept <= 10 * rows
    scene.observe(observer, "constant")
    assert scene.observe(observer, "sine").circle is not None


def test_findings_of_as_many_joints_as_a_robot_has_are_kept(observer: Observer) -> None:
    def finding(joint: str) -> Finding:
        return Finding(joint, (1,), False, 0.0, (0.0, 0.0, 9.8), None, None, "")

    for number in range(MAX_MODULES):
        observer.keep(finding(f"M{number}"))
    assert len(observer.findings) == MAX_MODULES >= 256
    # A joint that has moved again is not the one that moved longest ago.
    observer.keep(finding("M0"))
    observer.keep(finding("late"))
    assert "M1" not in observer.findings
    assert {"M0", "M2", "late"} <= set(observer.findings)


def test_without_rest_there_is_a_note_and_no_circle(horizontal_link: Any, observer: Observer) -> None:
    found = Scene(horizontal_link).observe(observer, "constant", rest=False)
    assert found.circle is None
    assert not found.moved
    assert "rest" in found.note


def test_the_rest_is_kept_when_the_history_has_long_forgotten_it(
    horizontal_link: Any, observer: Observer
) -> None:
    scene = Scene(horizontal_link)
    scene.observe(observer, "constant")
    # A ring that holds the last motion only.
    rows = scene.history.rows(scene.history.next_row - 1700, scene.history.next_row)
    short = History(1700)
    short.next_row = scene.history.next_row - 1700
    for row in rows:
        short.append(_values(row))
    assert short.first_row > scene.rest.end_row  # type: ignore[operator]
    found = observer.job(scene.motions["sine"], short, scene.rest)()
    assert found.note == ""
    assert found.circle is not None


def test_a_motion_without_rows_or_elsewhere_in_time_is_a_note_not_a_crash(
    horizontal_link: Any, observer: Observer
) -> None:
    scene = Scene(horizontal_link)
    whole = scene.motions["constant"]
    for odd in (
        whole._replace(rows=whole.rows[:0]),
        whole._replace(rows=whole.rows[:3]),
        whole._replace(rough_offset_ns={}),
    ):
        found = observer.job(odd, scene.history, scene.rest)()
        assert found.note
        assert found.circle is None
        assert not found.moved


def test_the_work_holds_copies_so_that_ticks_may_go_on_meanwhile(
    horizontal_link: Any, observer: Observer
) -> None:
    scene = Scene(horizontal_link, history_rows=3000)
    scene.observe(observer, "constant")
    job = observer.job(scene.motions["sine"], scene.history, scene.rest)
    before = job()
    blank = _values(np.zeros(1, dtype=ROW)[0])
    for _ in range(3000):
        scene.history.append(blank)
    assert job() == before


def test_the_regression_comes_with_the_circle_and_is_closer(horizontal_link: Any, observer: Observer) -> None:
    gravity = 9.81 * np.array(horizontal_link.gravity) / np.linalg.norm(horizontal_link.gravity)
    hinge = horizontal_link._replace(gravity=gravity)
    scene = Scene(hinge, seed=1)
    first = scene.observe(observer, "constant")
    found = scene.observe(observer, "sine")
    assert first.regression is None
    regression = found.regression
    assert regression is not None
    # An IMU as delivered: its scale is believed to 1 %, and gravity tells it better.
    assert regression.distance_m == pytest.approx(0.245, abs=2e-3)
    assert abs(regression.distance_m - 0.245) < 3.0 * regression.sigma_distance_m
    assert regression.sigma_distance_m < 2.4e-3
    assert np.degrees(np.arccos(min(1.0, np.dot(regression.axis, hinge.axis)))) < 1.0
    assert regression.delay_s == pytest.approx(-12e-3, abs=1e-3)
    assert not regression.base_shakes


def test_a_gap_in_a_joints_rows_costs_the_samples_around_it(horizontal_link: Any, observer: Observer) -> None:
    scene = Scene(horizontal_link)
    motion = scene.motions["sine"]
    rows = np.delete(motion.rows, slice(700, 720))
    scene.motions["sine"] = motion._replace(rows=rows)
    scene.observe(observer, "constant")
    found = scene.observe(observer, "sine")
    whole = Observer(observer.serial, observer.boot)
    scene.motions["sine"] = motion
    scene.observe(whole, "constant")
    without = scene.observe(whole, "sine")
    assert found.circle is not None
    assert found.regression is not None
    assert without.regression is not None
    assert not found.note
    # The low-pass of 28 ms reaches 140 ms to either side: 90 of the motions' 1650 samples, of every seventh.
    assert without.regression.samples - found.regression.samples == pytest.approx(13, abs=3)
    off_m = found.regression.distance_m - without.regression.distance_m
    assert abs(off_m) < 0.5 * found.regression.sigma_distance_m
