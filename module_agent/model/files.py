"""Files that are written whole or not at all: a reader, or a crash, finds the old file or the new one."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; what is written there takes its place if nothing was raised.

    Raises:
        OSError: the file cannot be written or put in its place; it names the file, also of a full disk.
    """
    temporary = path.with_name(path.name + ".part")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        if temporary.is_file():
            temporary.unlink()
        # A full disk is reported without the file; without a number it is no error of the system.
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, document: object) -> None:
    """Write a JSON file of a pydantic model (by alias), or of plain data without NaN and infinities.

    Raises:
        OSError: the file cannot be written.
        ValueError: a number is not finite.
    """
    write_text(path, json_text(document))


def json_text(document: object) -> str:
    """Return the JSON of a pydantic model (by alias), or of plain data without NaN and infinities.

    Raises:
        ValueError: a number is not finite.
    """
    if isinstance(document, BaseModel):
        return document.model_dump_json(indent=1, by_alias=True) + "\n"
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
