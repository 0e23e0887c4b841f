"""What is said in a life is counted as a false alarm, as naming the change rightly, or wrongly."""

from sim.benchmark.monitored_life import (
    LIFE_S,
    Life,
    LifePlan,
    Said,
    false_alarms,
    lives,
    summary,
)
from sim.benchmark.slow_change import ChangeKind, SlowChange

JOINT, OTHER = "elbow", "wrist-1"


def said(t_s: float, kind: str, serial: str = JOINT, size: float = 0.0, kept: bool = True) -> Said:
    return Said(t_s, kind, serial, f"{kind} of {serial}", size, kept)


def life(kind: ChangeKind | None, *heard: Said) -> Life:
    change = None if kind is None else SlowChange(kind, JOINT, 50.0, (1.0, 0.0, 0.0), 60.0, 300.0)
    plan = LifePlan("a2085_03", 0, "x5", 0, 420.0, kind)
    return Life(plan, change, 420.0, 420.0 if kind is None else 60.0, heard, 10.0)


def test_whatever_is_said_of_an_unchanged_robot_is_a_false_alarm_withdrawn_or_not() -> None:
    quiet = life(None, said(10.0, "collision"), said(20.0, "wear", kept=False))
    alarms = false_alarms([quiet, life(None)])
    assert (alarms.alarms, alarms.monitored_s) == (2, 840.0)


def test_before_a_change_all_is_unchanged() -> None:
    alarms = false_alarms([life("friction", said(30.0, "friction"), said(90.0, "friction", size=5.0))])
    assert (alarms.alarms, alarms.monitored_s) == (1, 60.0)


def test_a_change_is_named_rightly_by_kind_and_module() -> None:
    assert life("friction", said(200.0, "friction")).outcome == "rightly"
    assert life("friction", said(200.0, "friction", OTHER)).outcome == "wrongly"
    assert life("friction", said(200.0, "wear")).outcome == "wrongly"
    assert life("friction", said(200.0, "wear"), said(210.0, "friction")).outcome == "and wrongly"
    assert life("friction", said(200.0, "wear", kept=False), said(210.0, "friction")).outcome == "rightly"
    assert life("friction", said(200.0, "friction", kept=False)).outcome == "missed"


def test_a_sensor_is_named_with_its_module_or_as_unexplained_and_play_by_nothing() -> None:
    assert life("torque-scale", said(200.0, "unexplained", OTHER)).outcome == "rightly"
    assert life("torque-scale", said(200.0, "torque-sensor")).outcome == "rightly"
    assert life("torque-scale", said(200.0, "torque-sensor", OTHER)).outcome == "wrongly"
    assert life("accel-bias", said(200.0, "gyro")).outcome == "wrongly"
    assert life("play", said(200.0, "friction")).outcome == "wrongly"
    assert life("play").outcome == "missed"


def test_the_table_has_when_it_was_named_and_how_large_it_was_then() -> None:
    found = summary(
        [
            life("friction", said(160.0, "friction", size=20.0)),
            life("friction", said(260.0, "friction", size=40.0), said(261.0, "wear")),
            life("friction", said(260.0, "wear")),
            life("friction"),
        ]
    )
    one = found["friction"]
    assert one.outcomes == {"rightly": 1, "and wrongly": 1, "wrongly": 1, "missed": 1}
    assert (one.named_s, one.size, one.called) == (150.0, 30.0, {"wear": 2})
    assert list(found) == ["friction"]


def test_hours_are_shared_among_robots_and_every_life_is_another() -> None:
    planned = lives(("a2085_03", "arm6"), 1.0, ("play", "link"), 3, 0, "x5", "d-optimal")
    for robot in ("a2085_03", "arm6"):
        own = [plan for plan in planned if plan.robot == robot]
        assert sum(plan.for_s for plan in own if plan.change is None) == 1800.0
        assert max(plan.for_s for plan in own if plan.change is None) == LIFE_S
        assert sum(plan.change == "play" for plan in own) == 3
    assert len({(plan.robot, plan.seed, plan.day) for plan in planned}) == len(planned)
