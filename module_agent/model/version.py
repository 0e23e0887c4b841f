"""The version of what is installed."""

from importlib.metadata import PackageNotFoundError, version


def installed_version() -> str:
    """Return the version; a word where the package is not installed, but only on the path."""
    try:
        return version("x5-self-model")
    except PackageNotFoundError:
        return "not installed"
