"""`python -m tune` and the `svgf-tune` command: which options there are, and what becomes of errors."""

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NoReturn

from cyclopts import App, CycloptsError, Parameter

from svgf_jax import SvgfError, __version__, kept_programs
from svgf_jax.cli import app as svgf_jax
from svgf_jax.commands import terminal
from svgf_jax.commands.project import located, use_project
from svgf_jax.commands.settings import PROJECT, Largest
from tune.command import command

app: App = App(
    name="svgf-tune",
    help="Fit the filter's numbers to a renderer's own noise.",
    help_epilogue="The result: svgf-jax denoise INPUT -o FOLDER --params tuned.toml",
    version=__version__,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,  # `main` has something to say
)
app.meta.suppress_keyboard_interrupt = False
app.default(command)


@app.meta.default
def launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    config: Annotated[str, Parameter(metavar="FILE", group=PROJECT)] = "auto",
    largest: Largest = Largest(),
    completion: Annotated[Literal["bash", "zsh", "fish", "powershell"] | None, Parameter(group=PROJECT)] = None,
) -> Any:
    """Run with the project's file behind the command line.

    Args:
        config: Flags of this project, its tables [tune] and [all]; auto takes the nearest svgf-jax.toml, none ignores it.
        completion: Print a script that completes this command in a shell, and do nothing else.
    """
    if completion is not None:
        print(app.generate_completion(shell=completion), end="")
        return 0
    use_project(app, config, commands=svgf_jax, table="tune")
    try:
        with located(app), largest.held():
            return app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
    finally:
        app.config = ()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and exit: 0; 1 if a validation sequence got worse or the solver lost its way; 2 for an error; 130 interrupted."""
    try:
        terminal.require_lines(sys.argv[1:] if arguments is None else arguments)
        code = app.meta(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        fail(f"{str(error).strip()} See `svgf-tune --help`.")
    except SvgfError as error:
        fail(str(error))
    except KeyboardInterrupt:
        terminal.tell("svgf-tune: interrupted")
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


def fail(message: str) -> NoReturn:
    """Tell an error and exit with 2."""
    terminal.tell(f"svgf-tune: {message}")
    sys.exit(2)


def run() -> None:
    """The process of the command."""
    kept_programs.keep()
    terminal.run_to_the_end(main)


if __name__ == "__main__":
    run()
