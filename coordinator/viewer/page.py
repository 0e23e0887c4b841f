"""A page that shows a run in a browser of this machine, live or from its recording."""

from collections.abc import Sequence
from types import TracebackType
from typing import Self
from urllib.parse import quote

from coordinator.viewer import viewer_process
from coordinator.viewer.targets import proxy_url
from module_agent.model.errors import RobotError, UsageError


class PageEnded(RobotError):
    """The program that serves a page has ended by itself; the message contains its output."""


class Page:
    """Serves a page on a port of 127.0.0.1, and its data on the next one, during a `with` block.

    Raises:
        UsageError: something listens on one of the two ports already.
        ViewerNotStarted: the program that serves it does not start.
    """

    def __init__(self, port: int, recordings: Sequence[str] = ()):
        for taken in (port, port + 1):
            if viewer_process.listens("127.0.0.1", taken):
                raise UsageError(
                    f"port {port}: something listens on port {taken} already; choose another, with one free "
                    "port after it"
                )
        # Without the address of its data the page is empty.
        self.url = f"http://127.0.0.1:{port}?url={quote(proxy_url(port + 1), safe='')}"
        self._served = viewer_process.start(recordings, port + 1, detached=False, page_port=port)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        viewer_process.stop(self._served)

    def check(self) -> None:
        """Check that the page is still served.

        Raises:
            PageEnded: it is not.
        """
        if self._served.process.poll() is not None:
            raise PageEnded(f"the viewer's page ended: {self._served.output_tail()}")
