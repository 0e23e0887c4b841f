"""Pictures of a recording without a screen, taken from a headless viewer once its picture is stable.

Needs Vulkan in software, on Debian the packages `mesa-vulkan-drivers` and `libvulkan1`.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rerun.experimental import ViewerClient

from coordinator.viewer import viewer_process
from coordinator.viewer.scene import entity_paths
from coordinator.viewer.scene.blueprint import TABS
from coordinator.viewer.targets import proxy_url
from coordinator.viewer.viewer_process import MAGIC, is_recording
from module_agent.model.errors import RobotError, UsageError

SETTLE_SECONDS = 40.0
SAME_PICTURES = 3
_POLL_SECONDS = 0.4
_NS_PER_S = 1e9


class ScreenshotFailed(RobotError):
    """No picture could be taken; the message says what to do."""


def screenshot(
    rrd: Path,
    out: Path,
    tab: str | None = None,
    size: tuple[int, int] = (1600, 900),
    at_s: float | None = None,
) -> None:
    """Write one picture of a recording as a PNG.

    Args:
        rrd: the recording.
        out: the PNG.
        tab: one of `blueprint.TABS`; the tab that the recording opens with if left out.
        size: width and height [pixels].
        at_s: the time since the beginning of the session [s]; its end if left out.

    Raises:
        OSError: the recording cannot be read, or the picture not be written.
        ScreenshotFailed: no software Vulkan, or the viewer did not settle.
        UsageError: no recording of a run, no such tab, or a time before or after the recording.
    """
    if tab is not None and tab not in TABS:
        raise UsageError(f"no tab {tab!r}; there are {', '.join(TABS)}")
    if not is_recording(rrd):
        raise UsageError(f"{rrd} is not a Rerun recording: it does not begin with {MAGIC.decode()!r}")
    port = viewer_process.free_port()
    options = ["--headless", "--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"]
    try:
        viewer = viewer_process.start(options, port, detached=False)
    except viewer_process.ViewerNotStarted as failure:
        raise ScreenshotFailed(_advice(str(failure))) from failure
    try:
        client = ViewerClient.connect(proxy_url(port))
        _open(client, rrd, at_s)
        if tab is not None:
            layout = client.get_blueprint("recording").blueprint
            client.set_blueprint(with_active_tab(layout, tab), "recording")
        _settle(client)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(client.take_screenshot())
    except ConnectionError as failure:
        # It listens before it draws, so without Vulkan it starts, and ends at the first picture.
        raise ScreenshotFailed(_advice(viewer.output_tail())) from failure
    finally:
        viewer_process.stop(viewer)


def _advice(output: str) -> str:
    return (
        "the headless viewer does not run here; it needs Vulkan in software: "
        f"`apt-get install mesa-vulkan-drivers libvulkan1`. Its output:\n{output}"
    )


def _open(client: ViewerClient, rrd: Path, at_s: float | None) -> None:
    """Open a recording, and show it at a time, by default its end."""
    client.open(str(rrd.resolve()))
    deadline = time.monotonic() + SETTLE_SECONDS
    while True:
        state = client.get_state()
        ends = [
            line.end
            for recording in state.recordings
            for line in recording.timelines
            if line.name == entity_paths.TIMELINE and line.end is not None
        ]
        if ends and not state.loading:
            break
        if time.monotonic() > deadline:
            raise ScreenshotFailed(
                f"{rrd} has no timeline {entity_paths.TIMELINE!r}: it is not the recording of a run"
            )
        time.sleep(_POLL_SECONDS)
    end_ns = int(ends[0])
    if at_s is not None and not 0.0 <= at_s <= end_ns / _NS_PER_S:
        raise UsageError(f"--at {at_s:g}: the recording is of 0 to {end_ns / _NS_PER_S:.1f} s")
    at_ns = end_ns if at_s is None else round(at_s * _NS_PER_S)
    client.set_time(entity_paths.TIMELINE, duration=np.timedelta64(at_ns, "ns"), play_state="paused")


def with_active_tab(blueprint: Mapping[str, Any], tab: str) -> dict[str, Any]:
    """Return a blueprint, in the form that the viewer returns, in which the tab of that name is in front.

    Raises:
        ScreenshotFailed: no tabs of it contain one of that name.
    """
    containers = {
        path: entry["ContainerBlueprint"]
        for path, entry in blueprint.items()
        if "ContainerBlueprint" in entry
    }
    named = [path for path, entry in containers.items() if entry.get("display_name") == tab]
    for path, entry in containers.items():
        inside = entry.get("contents", [])
        # A single entry is not in a list, and paths are with or without a leading slash.
        inside = ["/" + p.lstrip("/") for p in ([inside] if isinstance(inside, str) else inside)]
        if entry.get("container_kind") == "Tabs" and named and named[0] in inside:
            turned = {"ContainerBlueprint": {**entry, "active_tab": named[0].lstrip("/")}}
            return {**blueprint, path: {**blueprint[path], **turned}}
    raise ScreenshotFailed(f"the recording has no tab {tab!r}, so it is not the recording of a run")


def _settle(client: ViewerClient) -> None:
    """Wait until consecutive pictures are the same: the viewer reports ready before it has drawn."""
    deadline = time.monotonic() + SETTLE_SECONDS
    last, same = b"", 0
    while same < SAME_PICTURES:
        if time.monotonic() > deadline:
            raise ScreenshotFailed(f"the picture did not become stable within {SETTLE_SECONDS:.0f} s")
        state = client.get_state()
        picture = client.take_screenshot(max_size=960)
        still = picture == last and not state.loading
        same = same + 1 if still else 0
        last = picture
        time.sleep(_POLL_SECONDS)
