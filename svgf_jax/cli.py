"""The `svgf-jax` command line: which commands there are, and what becomes of errors.

cyclopts, because it makes commands out of typed, documented functions, loads them only when they are called, and costs
0.1 s; argparse would need every flag declared twice. Nothing here or in `commands` imports JAX, NumPy or rich at the
top: help and errors answer at once.
"""

import sys
from collections.abc import Sequence
from typing import NoReturn

from cyclopts import App, CycloptsError

from svgf_jax import __version__
from svgf_jax.types import SvgfError

app = App(
    name="svgf-jax",
    help="Denoise path-traced EXR sequences with spatiotemporal variance-guided filtering (SVGF).",
    help_epilogue="`svgf-jax demo` shows it at work on a small bundled sequence.",
    version=__version__,
    help_format="plaintext",
)
app.command("svgf_jax.commands.denoise:denoise", help="Denoise a sequence of EXR files into a folder.")
app.command("svgf_jax.commands.compare:compare", help="Measure a sequence against its reference.")
app.command("svgf_jax.commands.ablate:ablate", help="Measure what each part of the filter is worth.")
app.command("svgf_jax.commands.demo:demo", help="Denoise the bundled sample and measure the result.")
app.command("svgf_jax.commands.video:video", help="Show sequences side by side as a video.")
params = App(name="params", help="Show presets and parameters.", help_format="plaintext")
params.command("svgf_jax.commands.params:list_", name="list", help="List presets and parameters.")
params.command("svgf_jax.commands.params:show", help="Print parameters as TOML, ready for `denoise --params`.")
app.command(params)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0, 2 for an error that its message explains, 130 or 143 when interrupted."""
    try:
        code = app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        fail(f"{str(error).strip()} See `svgf-jax --help`.")
    except SvgfError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print("svgf-jax: interrupted; files with their final name are complete", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # `| head`: whoever read the output has had enough
        sys.stderr.close()
        sys.exit(0)
    sys.exit(code if isinstance(code, int) else 0)


def fail(message: str) -> NoReturn:
    """Tell an error and exit with 2."""
    print(f"svgf-jax: {message}", file=sys.stderr)
    sys.exit(2)
