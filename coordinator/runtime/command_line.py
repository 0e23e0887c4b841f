"""Command lines: commands imported on demand, options declared once, errors as exit codes."""

import asyncio
import dataclasses
import inspect
import logging
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NoReturn, get_type_hints

import typer
from typer.core import TyperGroup
from typer.main import get_command

from module_agent.model.errors import (
    EXIT_CODES,
    EXIT_INTERRUPTED,
    EXIT_SUSPECT,
    RobotError,
    UsageError,
    named_files,
)
from module_agent.model.settings import LOG_LEVELS, SETTINGS, read_settings, variable
from module_agent.model.suggestion import did_you_mean
from module_agent.model.version import installed_version

logger = logging.getLogger(__name__)

# How a command may end early; everything else is a programming error.
ENDINGS = (RobotError, asyncio.CancelledError, KeyboardInterrupt)


class CommandFailed(RobotError):
    """Ends a command with a sentence for the user and an exit code."""

    def __init__(self, text: str, exit_code: int):
        super().__init__(text)
        self.exit_code = exit_code


def fail(text: object, exit_code: int) -> NoReturn:
    """End the command with a sentence on standard error and an exit code."""
    raise CommandFailed(str(text), exit_code)


def end_if_suspect(suspicions: Sequence[str]) -> None:
    """End the command with `EXIT_SUSPECT` if a result is not to be believed as usual; each reason once."""
    if suspicions:
        fail(
            f"the result is not to be believed as usual: {'; '.join(dict.fromkeys(suspicions))}", EXIT_SUSPECT
        )


def ending(error: BaseException) -> RobotError:
    """Return the text and the exit code of a `RobotError` or an interruption, one of `ENDINGS`."""
    return error if isinstance(error, RobotError) else CommandFailed("interrupted", EXIT_INTERRUPTED)


def in_a_folder(file: Path | None) -> Path | None:
    """Check before the work that a file can be written at its end; for options that name one.

    Raises:
        UsageError: its folder does not exist, or it is a folder.
    """
    if file is not None and not file.parent.is_dir():
        raise UsageError(f"{file}: there is no folder {file.parent}")
    if file is not None and file.is_dir():
        raise UsageError(f"{file}: is a folder; name the file to write")
    return file


_NO_EXAMPLES: Mapping[str, str] = MappingProxyType({})


def lazy_app(
    program: str,
    help_text: str,
    package: str,
    table: Mapping[str, tuple[str, str]],
    examples: Mapping[str, str] = _NO_EXAMPLES,
    repeated: Collection[str] = tuple(SETTINGS),
    aliases: Mapping[str, str] = _NO_EXAMPLES,
) -> typer.Typer:
    """Return a program of these commands; the module of a command is imported when the command is called.

    Modules of commands import the estimators and take seconds to load; `--help` of the program lists the
    lines of the table instead. A `RobotError`, an interruption, or a file that cannot be used ends the
    program with a line on standard error and an exit code.

    Args:
        program: its name.
        help_text: what it does.
        package: where the modules of the commands are.
        table: by command, the place of its function (or group, a `typer.Typer`) in the package, and its help.
        examples: by command, command lines that its help ends with.
        repeated: names of the options that may be settings (see `settings`).
        aliases: by names that commands had once and that no help lists, the place of their function.
    """

    class Commands(TyperGroup):
        def __init__(self, **attributes: Any):
            super().__init__(**attributes)
            # The names alone: they serve to suggest the command that a mistyped one may have meant.
            self.commands = dict.fromkeys(table)  # type: ignore[assignment]

        def list_commands(self, ctx: Any) -> list[str]:
            return list(table)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            place = table[cmd_name][0] if cmd_name in table else aliases.get(cmd_name)
            if place is None:
                return None
            command = _loaded(cmd_name, f"{package}.{place}")
            if example := examples.get(cmd_name):
                command.epilog = f"Example: {example}"
            # Tools that only look at commands have no context.
            if ctx is not None:
                _take_settings(cmd_name, command, ctx, repeated)
            return command

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            with formatter.section("Commands"):
                formatter.write_dl([(name, line) for name, (_, line) in table.items()])

        def invoke(self, ctx: Any) -> Any:
            try:
                with named_files():
                    return super().invoke(ctx)
            except ENDINGS as error:
                end = ending(error)
                logger.debug("where it ended:", exc_info=error)
            typer.echo(f"{program}: {end}", err=True)
            raise typer.Exit(end.exit_code)

    app = typer.Typer(
        name=program,
        cls=Commands,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        help=help_text,
        epilog="Exit codes: " + "; ".join(f"{code} {meaning}" for code, meaning in EXIT_CODES.items()) + ".",
    )

    @app.callback()
    def options(
        context: typer.Context,
        version: Annotated[
            bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
        ] = False,
        log_level: Annotated[
            str,
            typer.Option(
                "--log-level", "-v", metavar="LEVEL", help=f"Log to stderr: {', '.join(LOG_LEVELS)}."
            ),
        ] = "",
    ) -> None:
        context.obj = read_settings(os.environ, Path()) if context.obj is None else context.obj
        for source, level in (
            ("--log-level", log_level),
            (variable("log_level"), os.environ.get(variable("log_level"))),
            ("log_level of x5.toml", context.obj.get("log_level")),
        ):
            if level:
                log(level, source)
                return

    return app


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(installed_version())
        raise typer.Exit


def log(level: str, source: str = "--log-level") -> None:
    """Log to standard error from this level on; at `debug` and `info` Zenoh says what it does as well.

    `source` is where the level was given.

    Raises:
        UsageError: there is no such level.
    """
    if level not in LOG_LEVELS:
        raise UsageError(
            f"{source} {level}: it must be one of {', '.join(LOG_LEVELS)}{did_you_mean(level, LOG_LEVELS)}"
        )
    if level != "warning":  # which is Python's own default
        logging.basicConfig(level=level.upper(), format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    if level in ("debug", "info"):
        os.environ.setdefault("RUST_LOG", f"zenoh={level}")


def _take_settings(name: str, command: Any, context: Any, names: Collection[str]) -> None:
    """Let the options of a command that repeat be settings: variables of the environment, or of the file."""
    settings = context.obj if context.obj is not None else read_settings(os.environ, Path())
    context.obj = settings
    defaults = _defaults(command, settings, names)
    context.default_map = {**(context.default_map or {}), name: defaults}


def _defaults(command: Any, settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the settings of a command, of a group by its commands, and let its variables be settings."""
    if commands := getattr(command, "commands", None):
        return {name: _defaults(each, settings, names) for name, each in commands.items()}
    repeated = [p for p in command.params if p.param_type_name == "option" and p.name in names]
    for option in repeated:
        option.envvar = variable(option.name)
    invoke = command.invoke

    def invoke_by_rank(called: Any) -> Any:
        # Routers of a setting do not take the place of the endpoint that a command line gives.
        if "connect" in called.params and _rank(called, "listen") > _rank(called, "connect"):
            called.params["connect"] = None
        return invoke(called)

    command.invoke = invoke_by_rank
    return {option.name: settings[option.name] for option in repeated if option.name in settings}


_RANKS = ("DEFAULT", "DEFAULT_MAP", "ENVIRONMENT", "COMMANDLINE")


def _rank(called: Any, option: str) -> int:
    """Return what takes precedence: a command line over a variable over the file over the default."""
    source = called.get_parameter_source(option)
    return _RANKS.index(source.name) if source is not None and source.name in _RANKS else 0


def _loaded(name: str, place: str) -> Any:
    # Threads of BLAS gain nothing on matrices of a robot's size, and on busy cores they wait for each other.
    # The library reads this as it is loaded; processes that a command starts inherit it.
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(threads, "1")
    module, _, function = place.rpartition(".")
    loaded = getattr(import_module(module), function)
    if not isinstance(loaded, typer.Typer):
        single = typer.Typer(add_completion=False, rich_markup_mode=None)
        single.command(name)(loaded)
        loaded = single
    return get_command(loaded)


def with_options(function: Callable[..., None]) -> Callable[..., None]:
    """Expand every parameter whose type is a dataclass into options, one for each of the dataclass' fields.

    The fields are annotated as the parameters of a typer command. The function is called
    with instances of the dataclasses.
    """
    signature = inspect.signature(function)
    kinds = {
        p.name: p.annotation
        for p in signature.parameters.values()
        if isinstance(p.annotation, type) and dataclasses.is_dataclass(p.annotation)
    }
    parameters: list[inspect.Parameter] = []
    keyword = inspect.Parameter.KEYWORD_ONLY
    for parameter in signature.parameters.values():
        if parameter.name not in kinds:
            parameters.append(parameter.replace(kind=keyword))
            continue
        hints = get_type_hints(kinds[parameter.name], include_extras=True)
        for field in dataclasses.fields(kinds[parameter.name]):
            default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
            hint = hints[field.name]
            parameters.append(inspect.Parameter(field.name, keyword, default=default, annotation=hint))

    def command(**values: Any) -> None:
        for name, kind in kinds.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in dataclasses.fields(kind)})
        function(**values)

    command.__doc__ = function.__doc__
    command.__name__ = function.__name__
    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command
