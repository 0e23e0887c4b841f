"""Live viewers that listen, do not listen, or die: the file is complete in every case."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from coordinator.viewer import viewer_process
from coordinator.viewer.page import Page, PageEnded
from coordinator.viewer.targets import ViewerTargets, proxy_url
from coordinator.viewer.viewer import Viewer
from module_agent.wire.feedback_rows import Rows

Read = Callable[[Path, str], pd.DataFrame]
MakeRows = Callable[[int, int], Rows]


def log(viewer: Viewer, make_rows: MakeRows, first: int, count: int) -> None:
    for i in range(first, first + count, 5):
        viewer.rows("a", 4_000_000 * np.arange(i, i + 5), make_rows(i, 5))


def test_without_a_viewer_at_the_address_the_file_is_complete(
    tmp_path: Path, make_rows: MakeRows, read: Read, caplog: pytest.LogCaptureFixture
) -> None:
    file, url = tmp_path / "run.rrd", proxy_url(viewer_process.free_port())
    viewer = Viewer("arm", "r", ViewerTargets(rrd=file, connect=url))
    log(viewer, make_rows, 0, 500)
    viewer.close()
    assert f"no viewer listens at {url}" in caplog.text
    assert len(read(file, "/modules/a/gyro")) == 100


def test_an_address_of_another_kind_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    viewer = Viewer("arm", "r", ViewerTargets(rrd=tmp_path / "run.rrd", connect="127.0.0.1:9876"))
    viewer.close()
    assert "'127.0.0.1:9876' is no viewer's address; one looks like 'rerun+http://" in caplog.text


def test_a_file_that_cannot_be_written_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        Viewer("arm", "r", ViewerTargets(rrd=tmp_path))


@pytest.mark.integration
def test_a_viewer_that_dies_in_the_middle_leaves_the_file_complete(
    tmp_path: Path, make_rows: MakeRows, read: Read, caplog: pytest.LogCaptureFixture
) -> None:
    file, port = tmp_path / "run.rrd", viewer_process.free_port()
    other = viewer_process.start(["--serve-grpc"], port, detached=False)
    viewer = Viewer("arm", "r", ViewerTargets(rrd=file, connect=proxy_url(port)))
    log(viewer, make_rows, 0, 250)
    other.process.kill()
    other.process.wait()
    log(viewer, make_rows, 250, 250)
    viewer.close()
    assert viewer.failed == 0
    assert "a live viewer did not receive everything" in caplog.text
    assert len(read(file, "/modules/a/gyro")) == 100


@pytest.mark.integration
def test_a_page_and_its_data_are_served_to_this_machine_only_until_it_is_left(page_port: int) -> None:
    port = page_port
    with Page(port):
        listening = subprocess.run(["ss", "-ltnH"], capture_output=True, text=True, check=True).stdout
        ours = [line.split()[3] for line in listening.splitlines() if line.split()[3].endswith(f":{port}")]
        assert ours == [f"127.0.0.1:{port}"]
        assert viewer_process.listens("127.0.0.1", port + 1)
    assert not viewer_process.listens("127.0.0.1", port)
    assert not viewer_process.listens("127.0.0.1", port + 1)


@pytest.mark.integration
def test_a_page_whose_server_died_is_reported_with_its_output(page_port: int) -> None:
    with Page(page_port) as page:
        page.check()
        page._served.process.kill()
        page._served.process.wait()
        with pytest.raises(PageEnded, match="the viewer's page ended"):
            page.check()


@pytest.mark.integration
def test_a_viewer_that_does_not_start_reports_its_output() -> None:
    with pytest.raises(viewer_process.ViewerNotStarted, match="--no-such-option"):
        viewer_process.start(["--no-such-option"], viewer_process.free_port(), detached=False)
