"""`x5-coordinator view`, and the page of `run`: what is no recording is refused; pages last until Ctrl-C."""

import os
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import quote

import pytest
from typer.testing import CliRunner

from coordinator.identification.result import Result
from coordinator.main import app
from coordinator.recording.run_folder import RESULT, VIEW
from coordinator.runtime.event_loop import SIGNALS
from coordinator.session.run import RunConfig
from coordinator.viewer import viewer_process
from coordinator.viewer.page import Page
from coordinator.viewer.targets import ViewerTargets, proxy_url
from coordinator.viewer.viewer import Viewer


@pytest.mark.parametrize("command", ["view", "screenshot"])
def test_what_is_no_recording_is_refused_with_what_is_expected(tmp_path: Path, command: str) -> None:
    options = ["--out", str(tmp_path / "run.png")] if command == "screenshot" else []
    done = CliRunner().invoke(app, [command, str(tmp_path), *options])
    assert done.exit_code == 2
    assert f"{tmp_path / VIEW}: there is no such recording" in done.output
    (tmp_path / VIEW).write_text("a text")
    done = CliRunner().invoke(app, [command, str(tmp_path), *options])
    assert done.exit_code == 2
    assert "is not a Rerun recording" in done.output


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
def test_a_served_recording_is_a_page_that_knows_its_data_until_ctrl_c(
    tmp_path: Path, page_port: int
) -> None:
    viewer = Viewer("arm", "r", ViewerTargets(rrd=tmp_path / VIEW))
    viewer.phase(0, "discover")
    viewer.close()
    port = page_port
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


def address(port: int) -> str:
    return f"http://127.0.0.1:{port}?url={quote(proxy_url(port + 1), safe='')}"


@pytest.fixture
def handlers_kept() -> Iterator[None]:
    """A command handles signals until its process ends; here that is the process of all tests."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
@pytest.mark.usefixtures("handlers_kept")
@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_a_run_says_where_its_page_is_and_serves_it_after_its_end_until_ctrl_c(
    known_folder: Callable[..., Path],
    page_port: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    quiet: tuple[str, ...],
) -> None:
    result = Result.model_validate_json((known_folder("thesis_171_horizontal") / RESULT).read_bytes())
    served_after_the_end: list[bool] = []
    idle = signal.getsignal(signal.SIGINT)

    def look_and_interrupt() -> None:
        for _ in range(400):
            if signal.getsignal(signal.SIGINT) is not idle:
                break
            time.sleep(0.05)
        else:
            return  # it does not wait for a signal, which would end all tests
        served_after_the_end.append(viewer_process.listens("127.0.0.1", page_port))
        os.kill(os.getpid(), signal.SIGINT)

    looking = threading.Thread(target=look_and_interrupt)

    def identified(config: RunConfig, *_: object) -> tuple[Result, None]:
        assert config.viewer.connect == proxy_url(page_port + 1)
        assert viewer_process.listens("127.0.0.1", page_port + 1)
        looking.start()
        return result, None

    monkeypatch.setattr("coordinator.commands.run.run_attended", identified)
    options = ("--out", str(tmp_path / "run"), "--viewer", "serve", "--serve-port", str(page_port), *quiet)
    done = CliRunner().invoke(app, ["run", *options, "--json", "-"])
    looking.join()
    assert done.exit_code == 0, done.output
    assert f"open {address(page_port)} in a browser" in done.stderr
    # Standard output has nothing but the result.
    assert Result.model_validate_json(done.stdout) == result
    assert served_after_the_end == [True]
    assert not viewer_process.listens("127.0.0.1", page_port)


@pytest.mark.integration
@pytest.mark.xdist_group("integration")
def test_a_page_on_a_taken_port_is_refused_before_the_run_begins(page_port: int, tmp_path: Path) -> None:
    with Page(page_port):
        options = ("--out", str(tmp_path / "run"), "--viewer", "serve", "--serve-port", str(page_port))
        done = CliRunner().invoke(app, ["run", *options])
    assert done.exit_code == 2
    assert f"something listens on port {page_port} already" in done.output
    assert not (tmp_path / "run").exists()
