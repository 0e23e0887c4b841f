"""What leaves with a run is what was measured, on one time base, as the programs that read it see it."""

import base64
import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from coordinator.api import export_urdf, load_run
from coordinator.export import exported_run
from coordinator.export.exported_run import exported, read_exported
from coordinator.export.frames import instants_frame
from coordinator.export.instants import at_instants
from coordinator.export.ros2 import Ros2Writer, ros_name
from coordinator.main import app
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Entry, Recording
from coordinator.recording.run_folder import RESULT, SESSION, URDF, load_recording
from coordinator.recording.session_file import SessionWriter
from coordinator.synchronisation.signals import Signals
from module_agent.model.errors import DataError, UsageError
from module_agent.model.forward_kinematics import imu_poses
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.keys import Leaf

ROBOT = "thesis_171_horizontal"
SHOULDER, ELBOW = "X-00009", "X-00010"
# Module time of session time zero: minutes and years of uptime apart.
CLOCKS_NS = {SHOULDER: 77_000_000_000, ELBOW: 63_000_000_000_000_000}
ROWS, PERIOD_NS, TICK_NS = 1000, 4_000_000, 1_000_000
# A session that begins in November 2026.
BEGIN_NS = 1_795_000_000_000_000_000


def positions(t_s: np.ndarray) -> np.ndarray:
    """Both joints do the same at the same time, so that clocks that are not applied show."""
    return 0.7 * np.sin(2.0 * np.pi * 1.3 * t_s) + 0.1


def module_rows(serial: str, offset_ns: int) -> np.ndarray:
    rng = np.random.default_rng(len(serial) + offset_ns)
    since_ns = offset_ns + PERIOD_NS * np.arange(ROWS)
    rows = np.zeros(ROWS, ROW)
    rows["t_ns"] = rows["imu_t_ns"] = since_ns + CLOCKS_NS[serial]
    rows["position_rad"] = positions(1e-9 * since_ns)
    rows["position_command_rad"] = np.nan
    rows["state"] = 2
    for name in ("velocity_rad_s", "effort_nm", "motor_current_a", "gyro_rad_s", "accel_m_s2"):
        rows[name] = rng.normal(size=rows[name].shape)
    return rows


def entries(wire: SimpleNamespace, without_trips: tuple[str, ...] = ()) -> list[Entry]:
    """A session of two modules, with a request to both every 40 ms that each answers after 1 ms."""
    found = [wire.journal("session", BEGIN_NS, robot=ROBOT)]
    rows = {SHOULDER: module_rows(SHOULDER, 0), ELBOW: module_rows(ELBOW, 1_300_000)}
    for first in range(0, ROWS, 10):
        since_ns = PERIOD_NS * (first + 10)
        for serial in (SHOULDER, ELBOW):
            block = rows[serial][first : first + 10]
            found.append(
                wire.publication(
                    Leaf.FEEDBACK, wire.feedback(serial, first=first, rows=block), BEGIN_NS + since_ns
                )
            )
            if serial not in without_trips:
                found.append(wire.request(Leaf.STATUS, wire.ask(serial, seq=first + 1), BEGIN_NS + since_ns))
                answered_ns = since_ns + TICK_NS
                answer = wire.status(serial, re=first + 1, t_ns=answered_ns + CLOCKS_NS[serial])
                found.append(wire.reply(Leaf.STATUS, answer, BEGIN_NS + answered_ns + TICK_NS))
    return found


def write_session(folder: Path, all_entries: list[Entry]) -> Path:
    folder.mkdir(exist_ok=True)
    writer = SessionWriter(folder / SESSION)
    for entry in all_entries:
        writer.write(entry)
    writer.close()
    return folder


@pytest.fixture
def folder(known_folder: Callable[..., Path], wire: SimpleNamespace) -> Path:
    """A finished run of two modules."""
    run = write_session(known_folder(ROBOT), entries(wire))
    export_urdf(load_run(run), run / URDF)
    return run


def export(folder: Path, to: str, *options: str) -> Path:
    out = folder / f"exported.{'mcap' if to in ('ros2', 'foxglove') else to}"
    done = CliRunner().invoke(app, ["export", str(folder), "--to", to, "--out", str(out), *options])
    assert done.exit_code == 0, done.output
    return out


def measured(folder: Path, serial: str) -> np.ndarray:
    log = load_recording(folder / SESSION).modules[serial].rows
    return log.rows(0, ROWS)


# ---------------------------------------------------------------------- tables


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_pandas_reads_a_table_to_the_last_bit(folder: Path, to: str) -> None:
    out = export(folder, to)
    table = pd.read_csv(out) if to == "csv" else pd.read_parquet(out)
    assert len(table) == 2 * ROWS
    assert np.all(np.diff(table["t_s"]) >= 0.0)
    for serial in (SHOULDER, ELBOW):
        rows, shown = measured(folder, serial), table[table["module"] == serial]
        np.testing.assert_array_equal(shown["position_rad"], rows["position_rad"])
        np.testing.assert_array_equal(shown["effort_nm"], rows["effort_nm"])
        np.testing.assert_array_equal(shown["gyro_y_rad_s"], rows["gyro_rad_s"][:, 1])
        assert shown["position_command_rad"].isna().all()
        assert set(shown["state"]) == {"moving"}


def test_clocks_that_are_years_apart_are_one_time_base(folder: Path) -> None:
    """Answers come in the middle of their round trips, so that the clocks are known to the nanosecond."""
    frame = load_run(folder).frame()
    error = frame["position_rad"] - positions(frame["t_s"].to_numpy())
    # 0.7 rad at 1.3 Hz is at most 5.7 rad/s: a microsecond of clock error would be 6e-6 rad.
    assert np.abs(error).max() < 1e-7
    assert set(frame["module"]) == {SHOULDER, ELBOW}


def test_at_common_instants_every_module_has_a_column(folder: Path) -> None:
    frame = load_run(folder).frame(rate_hz=100.0)
    np.testing.assert_allclose(np.diff(frame["t_s"]), 0.01, atol=1e-12)
    inside = frame[(frame["t_s"] > 0.02) & (frame["t_s"] < 3.9)]
    for serial in (SHOULDER, ELBOW):
        # Linear interpolation over 4 ms errs by (2 pi 1.3)^2 0.7 0.004^2 / 8 = 9e-5 rad at most.
        error = inside[f"{serial}.position_rad"] - positions(inside["t_s"].to_numpy())
        assert np.abs(error).max() < 1e-4
        assert set(inside[f"{serial}.state"]) == {"moving"}
    # Before its first sample a module has no position, and no state either.
    assert np.isnan(frame[f"{ELBOW}.position_rad"].iloc[0])
    assert frame[[f"{ELBOW}.state", f"{ELBOW}.motion_id"]].iloc[0].isna().all()
    # Before the first one of any there is no instant.
    assert frame[f"{SHOULDER}.position_rad"].notna().iloc[0]


def constant(t_s: np.ndarray) -> Signals:
    fields = {name: np.ones(len(t_s)) for name in Signals._fields}
    vectors = {name: np.ones((len(t_s), 3)) for name in ("gyro_rad_s", "accel_m_s2")}
    whole = {name: np.ones(len(t_s), dtype=np.int64) for name in ("motion_id", "state")}
    return Signals(**{**fields, **vectors, **whole, "t_s": t_s, "imu_t_s": t_s})


def test_nothing_is_invented_in_a_hole() -> None:
    t_s = np.concatenate([np.arange(0.0, 1.0, 0.004), np.arange(2.0, 3.0, 0.004)])
    instants = at_instants({"a": constant(t_s)}, 100.0)
    known, t = ~np.isnan(instants.signals["a"].position_rad), instants.t_s
    np.testing.assert_array_equal(known, (t <= 0.996) | (t >= 2.0) & (t <= 2.996))
    np.testing.assert_array_equal(known, ~np.isnan(instants.signals["a"].gyro_rad_s[:, 2]))


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), 1e9])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    with pytest.raises(UsageError, match="instants per second"):
        at_instants({"a": constant(np.arange(3.0))}, rate_hz)


def test_a_rate_of_which_no_instant_is_recorded_is_refused() -> None:
    with pytest.raises(UsageError, match="the recording is too short to have one of them"):
        at_instants({"a": constant(np.linspace(1.0, 3.0, 9))}, 0.2)


def test_no_two_modules_share_a_topic(tmp_path: Path) -> None:
    """Serials may differ in signs that names of topics have not."""
    serials = ("J-1", "J.1", "J_1", "2")
    with (tmp_path / "bag.mcap").open("wb") as file, Ros2Writer(file, {}) as writer:
        for _ in range(2):
            for serial in serials:
                writer.imu(1, serial, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))
    with (tmp_path / "bag.mcap").open("rb") as written:
        topics = [channel.topic for _, channel, _ in make_reader(written).iter_messages()]
    assert topics == 2 * ["/imu/J_1", "/imu/J_1_2", "/imu/J_1_3", "/imu/m_2"]


# ---------------------------------------------------------------------- ROS 2


def ros2(file: Path) -> dict[str, list[SimpleNamespace]]:
    found: dict[str, list[SimpleNamespace]] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def stamp_ns(message: SimpleNamespace) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def test_the_reader_of_ros_2_reads_joints_and_imus_to_the_last_bit(folder: Path) -> None:
    topics = ros2(export(folder, "ros2"))
    (description,) = topics["/robot_description"]
    assert description.data == (folder / URDF).read_text()
    joints = {joint.get("name") for joint in ET.fromstring(description.data).findall("joint")}
    for serial in (SHOULDER, ELBOW):
        rows = measured(folder, serial)
        states = [one for one in topics["/joint_states"] if one.name == [f"joint_{serial}"]]
        assert f"joint_{serial}" in joints
        np.testing.assert_allclose([one.position[0] for one in states], rows["position_rad"])
        np.testing.assert_array_equal([one.effort[0] for one in states], rows["effort_nm"])
        since_ns = rows["t_ns"] - CLOCKS_NS[serial]
        # `t_s` is a float of seconds: of a few seconds it has 1e-6 ns.
        assert np.abs(np.array([stamp_ns(one) for one in states]) - BEGIN_NS - since_ns).max() <= 20
        imus = topics[f"/imu/{serial.replace('-', '_')}"]
        assert {one.header.frame_id for one in imus} == {f"imu_{serial}"}
        assert imus[0].orientation_covariance[0] == -1.0
        read = [[one.linear_acceleration.x, one.angular_velocity.z] for one in imus]
        expected = np.column_stack([rows["accel_m_s2"][:, 0], rows["gyro_rad_s"][:, 2]])
        np.testing.assert_array_equal(read, expected)


def test_transforms_lead_to_where_the_chain_says_the_imus_are(folder: Path) -> None:
    topics = ros2(export(folder, "ros2", "--rate-hz", "50"))
    chain, frames = load_run(folder).chain, {}
    for message in (topics["/tf_static"][0], topics["/tf"][70]):
        for one in message.transforms:
            pose = np.eye(4)
            rotation, translation = one.transform.rotation, one.transform.translation
            turn = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w])
            pose[:3, :3], pose[:3, 3] = turn.as_matrix(), [translation.x, translation.y, translation.z]
            frames[one.child_frame_id] = (one.header.frame_id, pose)
    stamp = stamp_ns(topics["/tf"][70].transforms[0])
    (state,) = [one for one in topics["/joint_states"] if stamp_ns(one) == stamp]
    q = dict(zip(state.name, state.position, strict=True))
    poses = imu_poses(chain, np.array([[q[f"joint_{serial}"] for serial in chain.serials]]))[0]
    for k, serial in enumerate(chain.serials):
        frame, pose = f"imu_{serial}", np.eye(4)
        while frame != "base":
            frame, step = frames[frame]
            pose = step @ pose
        # The URDF has 15 digits.
        np.testing.assert_allclose(pose, poses[k], atol=1e-12)


def test_everything_else_has_its_unit_in_its_name(folder: Path) -> None:
    first = next(
        one for one in ros2(export(folder, "ros2"))["/dynamic_joint_states"] if SHOULDER in one.joint_names[0]
    )
    values = dict(
        zip(first.interface_values[0].interface_names, first.interface_values[0].values, strict=True)
    )
    rows = measured(folder, SHOULDER)
    assert values["motor_current_a"] == rows["motor_current_a"][0]
    assert values["winding_temperature_c"] == 0.0
    assert np.isnan(values["position_command_rad"])


def test_rerun_opens_the_file_and_plots_the_same_positions(folder: Path) -> None:
    out = export(folder, "ros2")
    view = folder / "view.rrd"
    rerun = Path(sys.executable).parent / "rerun"
    subprocess.run(
        [rerun, "mcap", "convert", str(out), "-o", str(view)], check=True, capture_output=True, timeout=60
    )
    names, read = [], []
    for chunk in RrdReader(str(view)).stream():
        if chunk.entity_path != "/joint_states/position":
            continue
        columns = chunk.to_record_batch().to_pydict()
        for name, value in columns.items():
            names += [one[0] for one in value] if name.endswith("names") else []
            read += [one[0] for one in value] if name.endswith("scalars") else []
    expected = [measured(folder, serial)["position_rad"] for serial in (SHOULDER, ELBOW)]
    assert len(read) == 2 * ROWS
    np.testing.assert_allclose(np.sort(read), np.sort(np.concatenate(expected)))


@pytest.mark.parametrize(
    ("serial", "name"), [("X-00009", "X_00009"), ("elbow", "elbow"), ("9ü", "m_9_"), ("", "m_")]
)
def test_a_serial_becomes_a_token_that_ros_allows(serial: str, name: str) -> None:
    assert ros_name(serial) == name


# ---------------------------------------------------------------------- Foxglove


def test_foxglove_messages_have_what_their_schemas_require(folder: Path) -> None:
    with export(folder, "foxglove").open("rb") as file:
        messages = [
            (channel.topic, json.loads(schema.data), json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages()
            if schema is not None
        ]
    for topic, schema, message in messages:
        assert set(schema["required"]) <= message.keys() <= schema["properties"].keys(), topic
    described = next(message for topic, _, message in messages if topic == "/robot_description")
    assert base64.b64decode(described["data"]).decode() == (folder / URDF).read_text()
    for serial in (SHOULDER, ELBOW):
        joints = [message["joints"][0] for topic, _, message in messages if topic == "/joint_states"]
        read = [joint["position"] for joint in joints if joint["name"] == f"joint_{serial}"]
        np.testing.assert_array_equal(read, measured(folder, serial)["position_rad"])
        module = next(message for topic, _, message in messages if topic == f"/module/{serial}")
        assert module["position_command_rad"] is None


@pytest.mark.parametrize(("to", "what"), [("csv", "rows"), ("foxglove", "samples")])
def test_programs_are_told_what_was_written_and_what_is_missing(folder: Path, to: str, what: str) -> None:
    said = folder / "said.json"
    out = export(folder, to, "--json", str(said))
    told = json.loads(said.read_text())
    assert (told["file"], told["format"], told["modules"]) == (str(out), to, [SHOULDER, ELBOW])
    assert told[what] == 2 * ROWS
    assert told["missing"] == list(read_exported(folder).missing)


# ---------------------------------------------------------------------- what is missing


def test_a_run_that_did_not_end_exports_what_it_has_and_says_what_it_lacks(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    folder = write_session(tmp_path / "run", entries(wire, without_trips=(ELBOW,)))
    file = folder / SESSION
    # A crash cuts the file anywhere.
    file.write_bytes(file.read_bytes()[: 2 * file.stat().st_size // 3])
    done = CliRunner().invoke(
        app, ["export", str(folder), "--to", "ros2", "--out", str(tmp_path / "part.mcap")]
    )
    assert done.exit_code == 0, done.output
    assert f"the run has no {RESULT}" in done.output
    assert f"the run has no {URDF}: no robot description and no transforms" in done.output
    assert f"{ELBOW} is left out: no round trip maps its clock" in done.output
    topics = ros2(tmp_path / "part.mcap")
    assert "/tf" not in topics
    assert {one.name[0] for one in topics["/joint_states"]} == {f"joint_{SHOULDER}"}
    assert len(topics["/joint_states"]) > ROWS // 3


def test_lost_samples_and_damaged_places_are_said(folder: Path, wire: SimpleNamespace) -> None:
    kept = [entry for k, entry in enumerate(entries(wire)) if k not in (31, 37)]
    write_session(folder, kept)
    data = bytearray((folder / SESSION).read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / SESSION).write_bytes(data)
    missing = "\n".join(read_exported(folder).missing)
    assert "session.mcap is damaged from byte" in missing
    assert f"of {ROWS} samples were lost" in missing


def test_samples_from_before_a_module_booted_anew_are_said_to_be_left_out(wire: SimpleNamespace) -> None:
    recording = Recording()
    recording.add(
        wire.publication(Leaf.FEEDBACK, wire.feedback(ELBOW, boot=9, rows=module_rows(ELBOW, 0)[:500]), 1)
    )
    recording.modules[ELBOW].has_answered = True
    for entry in entries(wire):
        recording.add(entry)
    missing = [text for text in exported(recording, None, []).missing if "boot" in text]
    assert missing == [f"{ELBOW}: 500 samples of an earlier boot are left out, before it booted anew"]


def test_where_nothing_can_be_exported_it_is_said_why(tmp_path: Path, wire: SimpleNamespace) -> None:
    recording = load_recording(
        write_session(tmp_path / "run", entries(wire, without_trips=(SHOULDER, ELBOW))) / SESSION
    )
    with pytest.raises(DataError, match="no round trip maps its clock"):
        exported(recording, None, [])
    with pytest.raises(UsageError, match=r"holds no session\.mcap"):
        read_exported(tmp_path)


def test_without_a_journal_time_begins_with_the_first_sample(tmp_path: Path, wire: SimpleNamespace) -> None:
    whole = entries(wire)
    recording = load_recording(write_session(tmp_path / "run", whole[1:]) / SESSION)
    run = exported(recording, None, [])
    assert run.start_ns == BEGIN_NS
    assert JournalEvent.decode(whole[0].payload).robot != run.robot == "robot"


def test_a_package_that_is_missing_is_named_with_its_extra(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(name: str) -> ModuleSpec | None:
        return None

    monkeypatch.setattr(exported_run, "find_spec", nothing)
    done = CliRunner().invoke(app, ["export", str(folder), "--to", "ros2", "--out", str(folder / "x.mcap")])
    assert done.exit_code == 2
    assert "mcap-ros2" in done.output
    assert "x5-self-model[export]" in done.output
    with pytest.raises(UsageError, match="pandas"):
        instants_frame(read_exported(folder), 10.0)


def test_a_file_that_cannot_be_written_whole_is_not_there(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / URDF).write_text("<robot")
    done = CliRunner().invoke(app, ["export", str(folder), "--to", "ros2", "--out", str(folder / "x.mcap")])
    assert done.exit_code == 2
    assert "not XML" in done.output
    assert not list(folder.glob("x.mcap*"))
