"""The `svgf-jax` command line: which commands there are, and what becomes of errors.

cyclopts, because it makes commands out of typed, documented functions, and costs 0.1 s; argparse would need every flag
declared twice. Nothing here or in `commands` imports JAX, NumPy or rich at the top: help and errors answer at once.
"""

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NoReturn

from cyclopts import App, CycloptsError, Parameter

from svgf_jax import __version__
from svgf_jax.commands import terminal
from svgf_jax.commands.ablate import ablate
from svgf_jax.commands.compare import compare
from svgf_jax.commands.demo import demo
from svgf_jax.commands.denoise import denoise
from svgf_jax.commands.inspect import inspect
from svgf_jax.commands.params import diff, list_, show
from svgf_jax.commands.project import located, use_project
from svgf_jax.commands.settings import PROJECT, Largest
from svgf_jax.commands.video import video
from svgf_jax.types import SvgfError

app: App = App(
    name="svgf-jax",
    help="Denoise path-traced EXR sequences with spatiotemporal variance-guided filtering (SVGF).",
    help_epilogue="`svgf-jax demo` shows it at work on a small bundled sequence.",
    version=__version__,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,  # `main` has something to say
)
app.meta.suppress_keyboard_interrupt = False
app.command(denoise)
app.command(inspect)
app.command(compare)
app.command(ablate)
app.command(demo)
app.command(video)
params: App = App(name="params", help="Show and compare presets, methods and parameter files.", help_format="plaintext")
params.command(list_, name="list")
params.command(show)
params.command(diff)
app.command(params)


@app.command
def completion(shell: Literal["bash", "zsh", "fish", "powershell"], /, *, install: bool = False) -> None:
    """Print a script that completes commands and flags in a shell, for example: eval "$(svgf-jax completion bash)".

    Args:
        shell: Whose completion.
        install: Write it where the shell looks for it instead, and into the shell's start file where that is needed.
    """
    if install:
        print(app.install_completion(shell=shell))
    else:
        print(app.generate_completion(shell=shell), end="")


@app.meta.default
def launch(
    *tokens: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    config: Annotated[str, Parameter(metavar="FILE", group=PROJECT)] = "auto",
    largest: Largest = Largest(),
) -> Any:
    """Run a command with the project's file behind it.

    Args:
        config: Flags of this project, a table for each command or for all; auto takes the nearest svgf-jax.toml, none ignores it.
    """
    use_project(app, config, commands=app)
    try:
        with located(app), largest.held():
            return app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
    finally:
        app.config = ()


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0, 2 for an error that its message explains, 129, 130 or 143 when interrupted.

    Where whoever read the output has had enough (`| head`) it ends quietly: with 141 if there was more to come.
    """
    try:
        terminal.require_lines(sys.argv[1:] if arguments is None else arguments)
        code = app.meta(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        called = [name for name in (sys.argv[1:] if arguments is None else arguments)[:1] if name in app]
        fail(f"{str(error).strip()} See `{' '.join(['svgf-jax', *called, '--help'])}`.")
    except SvgfError as error:
        fail(str(error))
    except KeyboardInterrupt:
        terminal.tell("svgf-jax: interrupted; files with their final name are complete")
        leave(130)
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        terminal.silence(sys.stdout)  # rich makes a SystemExit of it
        leave(141)
    except OSError as error:
        if error.filename is not None:
            raise
        leave(_not_printed(error))  # files are written under their names
    leave(code if isinstance(code, int) else 0)


def leave(code: int) -> NoReturn:
    """Exit, with all that was printed handed over; with 2 where it could not be."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        terminal.silence(sys.stdout)
    except OSError as error:
        code = code or _not_printed(error)
    sys.exit(code)


def _not_printed(error: OSError) -> int:
    terminal.silence(sys.stdout)
    terminal.tell(f"svgf-jax: Could not write the standard output: {error.strerror}.")
    return 2


def fail(message: str) -> NoReturn:
    """Tell an error and exit with 2."""
    terminal.tell(f"svgf-jax: {message}")
    leave(2)
