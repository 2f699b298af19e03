"""The application `kcgs`, to which the other modules add their commands."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from kcgs.errors import InvalidArgument, InvalidArgumentType


class CommandGroup(TyperGroup):
    """A group of commands that reports an argument refused by the library as an option with a wrong value.

    The error for an unknown option lists the commands that have it, unless the command has a similar option.
    """

    def invoke(self, context: Any) -> Any:
        """Run the command that the context names."""
        try:
            return super().invoke(context)
        except (InvalidArgument, InvalidArgumentType) as error:
            name = context.invoked_subcommand
            command: Any = self.commands[name]
            for parameter in command.params:
                if parameter.name == error.name:
                    message = f"must {error.verb} {error.expected}; got {error.received}"
                    usage = typer.Context(command, context, name)
                    raise typer.BadParameter(message, usage, parameter) from error
            raise
        except Exception as error:
            if getattr(error, "possibilities", None) == []:  # typer exports no class of this error
                self._name_owners(error)
            raise

    def _name_owners(self, error: Any) -> None:
        """Add to the error for an unknown option the commands that have this option."""
        owners = [
            f"kcgs {name}"
            for name, command in self.commands.items()
            if any(error.option_name in parameter.opts for parameter in command.params)
        ]
        if owners:
            error.message += f", which is one of {', '.join(owners)}"


app = typer.Typer(
    cls=CommandGroup,
    help="Contour-aware 2D Gaussian splatting of images.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(version: bool) -> None:
    if version:
        from kcgs import __version__

        typer.echo(f"kcgs {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Take options that come before a command."""
