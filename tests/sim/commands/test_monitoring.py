"""Tables of the watch's trials count what there was and leave out what cannot be measured."""

import json

import pytest
from rich.console import Console

from sim.benchmark.cases.monitoring import Alarms, MonitoringTrial
from sim.commands.monitoring import confusion_table, figures, size_table, summary

HIT = MonitoringTrial("payload", "payload", True, 0.02, 2.5, 0.2, 0.003, 0, 20.0, ("0.203 kg",))
MISSED = HIT._replace(found="nothing", located=False, latency_s=None, named_s=None, size_error=None)
BLOW = MonitoringTrial("collision", "collision", True, 0.03, 0.03, 0.0, None, 0, 20.0, ())


def printed(table: object) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_a_missed_payload_counts_as_nothing_found_and_has_no_error() -> None:
    one = summary([HIT, MISSED, HIT._replace(size_error=-0.004)])["payload"]
    assert (one["trials"], one["right"], one["located"]) == (3, 2, 2)
    assert one["error_rms"] == pytest.approx(0.0035355, rel=1e-4)
    assert one["error_largest"] == 0.004
    assert one["named_s"] == 2.5


def test_a_blow_has_no_size_to_compare() -> None:
    assert summary([BLOW])["collision"]["sized"] is False
    assert "1 of 1" in printed(confusion_table([BLOW]))
    assert "0.030" in printed(size_table([BLOW]))


def test_figures_are_json_with_the_interval_of_the_false_alarms() -> None:
    written = json.loads(json.dumps(figures([HIT, MISSED, BLOW], Alarms(0, 1800.0))))
    assert written["confusion"] == {"payload": {"payload": 1, "nothing": 1}, "collision": {"collision": 1}}
    assert written["per_hour"] == 0.0
    # None in half an hour: up to twice the 3.69 of an hour.
    assert written["per_hour_interval_95"][1] == pytest.approx(2.0 * 3.689, abs=2e-3)
