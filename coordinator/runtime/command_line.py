"""Command lines: commands imported on demand, options declared once, errors as exit codes."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, NamedTuple, NoReturn, get_type_hints

import typer
from typer.core import TyperGroup
from typer.main import get_command

from module_agent.model.errors import RobotError


class LazyCommand(NamedTuple):
    """A command by the place of its function (or of its group, a `typer.Typer`), and a line of help."""

    module: str
    attribute: str
    help: str


class CommandFailed(RobotError):
    """Ends a command with a sentence for the user and an exit code."""

    def __init__(self, text: str, exit_code: int):
        super().__init__(text)
        self.exit_code = exit_code


def fail(text: object, exit_code: int) -> NoReturn:
    """End the command with a sentence on standard error and an exit code."""
    raise CommandFailed(str(text), exit_code)


def lazy_app(program: str, help_text: str, table: Mapping[str, LazyCommand]) -> typer.Typer:
    """Return a program of these commands; the module of a command is imported when the command is called.

    Modules of commands import the estimators and take seconds to load; `--help` of the program lists the
    lines of the table instead. A `RobotError` that leaves a command is printed on standard error and ends the
    program with its exit code.
    """

    class Commands(TyperGroup):
        def __init__(self, **attributes: Any):
            super().__init__(**attributes)
            # The names alone: they serve to suggest the command that a mistyped one may have meant.
            self.commands = dict.fromkeys(table)  # type: ignore[assignment]

        def list_commands(self, ctx: Any) -> list[str]:
            return list(table)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            return _loaded(cmd_name, table[cmd_name]) if cmd_name in table else None

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            with formatter.section("Commands"):
                formatter.write_dl([(name, command.help) for name, command in table.items()])

        def invoke(self, ctx: Any) -> Any:
            try:
                return super().invoke(ctx)
            except RobotError as error:
                typer.echo(f"{program}: {error}", err=True)
                raise typer.Exit(error.exit_code) from error

    app = typer.Typer(
        name=program,
        cls=Commands,
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        help=help_text,
    )
    # Without a callback typer takes a program for a single command.
    app.callback()(_no_callback)
    return app


def _no_callback() -> None:
    pass


def _loaded(name: str, command: LazyCommand) -> Any:
    loaded = getattr(import_module(command.module), command.attribute)
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
    kinds = {p.name: p.annotation for p in signature.parameters.values() if _is_options(p.annotation)}
    parameters = []
    for parameter in signature.parameters.values():
        if parameter.name in kinds:
            parameters += _fields(kinds[parameter.name])
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    def command(**values: Any) -> None:
        for name, kind in kinds.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in dataclasses.fields(kind)})
        function(**values)

    command.__doc__ = function.__doc__
    command.__name__ = function.__name__
    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def _is_options(annotation: object) -> bool:
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def _fields(kind: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(kind, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in dataclasses.fields(kind)
    ]
