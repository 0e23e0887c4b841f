"""One message in twenty is lost, and the recording is complete all the same."""

import json
from collections import Counter

from coordinator.recording.run_folder import RESULT, load_recording
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Feedback
from module_agent.wire.row_log import RowLog
from sim.scoring.score import score


def test_no_row_is_missing_when_the_network_drops_feedback(launcher, programs) -> None:
    robot = launcher(network="lossy")
    config = robot.config
    robot.start_world()
    robot.start_agents()
    coordinator = robot.start_coordinator(quiet=True)
    code, said = programs.ended(coordinator)
    assert code == 0, said
    robot.stop()

    recording = load_recording(config.out / "session.mcap")
    live: dict[str, RowLog] = {}
    answered: set[tuple[str, int]] = set()
    late: Counter[str] = Counter()
    questions = 0
    for entry in programs.entries(config.out / "session.mcap"):
        if entry.kind == "journal":
            continue
        leaf = parse(entry.topic).leaf
        questions += entry.kind == "request" and leaf is Leaf.HISTORY
        if (entry.kind, leaf) not in (("publication", Leaf.FEEDBACK), ("reply", Leaf.HISTORY)):
            continue
        feedback = decode(Feedback, entry.payload, MAX_MESSAGE_BYTES)
        rows = {(feedback.serial, feedback.first_row + k) for k in range(feedback.count)}
        if entry.kind == "reply":
            answered |= rows
        else:
            late[feedback.serial] += len(rows & answered)
            live.setdefault(feedback.serial, RowLog(feedback.boot)).add(feedback)
    assert questions > 0
    told = {each["serial"]: each for each in json.loads((config.out / RESULT).read_text())["feedback_losses"]}
    for serial in config.serials:
        log = recording.modules[serial].rows
        lost = live[serial].missing(live[serial].first_row, live[serial].end_row)
        # 13 s at 50 messages a second: some 30 are lost.
        assert len(lost) >= 5
        assert log.missing(log.first_row, log.end_row) == []
        # What was asked for counts as lost, also if it was late and came after all.
        lost_rows = log.count - live[serial].count + late[serial]
        assert lost_rows >= sum(end - first for first, end in lost)
        assert told[serial] == {"serial": serial, "received": log.count, "lost": lost_rows, "missing": 0}
    found = score(config.out)
    assert found.topology_correct
    assert abs(found.links[0].link_length_error_mm) <= 0.05 * found.links[0].link_length_true_mm
