"""`x5-coordinator view`: what is no recording is refused; a served page lasts until Ctrl-C."""

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from typer.testing import CliRunner

from coordinator.main import app
from coordinator.recording.run_folder import VIEW
from coordinator.viewer import viewer_process
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer


def test_what_is_no_recording_is_refused_with_what_is_expected(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["view", str(tmp_path)])
    assert done.exit_code == 2
    assert f"{tmp_path / VIEW}: there is no such recording" in done.output
    (tmp_path / VIEW).write_text("a text")
    done = CliRunner().invoke(app, ["view", str(tmp_path)])
    assert done.exit_code == 2
    assert "is not a Rerun recording" in done.output


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
def test_a_served_recording_is_a_page_that_knows_its_data_until_ctrl_c(tmp_path: Path) -> None:
    viewer = Viewer("arm", "r", ViewerTargets(rrd=tmp_path / VIEW))
    viewer.phase(0, "discover")
    viewer.close()
    # Two ports in a row: those of the kernel's choice seldom have a taken successor.
    port = next(
        p for p in iter(viewer_process.free_port, 0) if not viewer_process.listens("127.0.0.1", p + 1)
    )
    command = [
        sys.executable,
        "-m",
        "coordinator.main",
        "view",
        str(tmp_path),
        "--serve",
        "--port",
        str(port),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        said = process.stdout.readline()
        assert f"http://127.0.0.1:{port}?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{port + 1}%2Fproxy" in said
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10.0) as page:
            assert b"<html" in page.read().lower()
        assert viewer_process.listens("127.0.0.1", port + 1)
        taken = CliRunner().invoke(app, ["view", str(tmp_path), "--serve", "--port", str(port)])
        assert taken.exit_code == 2
        assert f"something listens on port {port} already" in taken.output
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == 0
        assert not viewer_process.listens("127.0.0.1", port)
        assert not viewer_process.listens("127.0.0.1", port + 1)
    finally:
        process.kill()
        process.communicate()
