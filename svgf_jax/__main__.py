"""`python -m svgf_jax` and the `svgf-jax` command."""


def main() -> None:
    """Run the command line."""
    import contextlib
    import faulthandler

    from svgf_jax import kept_programs, prints
    from svgf_jax.cli import main as cli_main
    from svgf_jax.commands import terminal

    terminal.open_streams()
    with contextlib.suppress(OSError, AttributeError, ValueError):  # a closed standard error
        faulthandler.enable()  # what the EXR or the video library breaks does not end in silence
    prints.set_results_apart()
    kept_programs.keep()
    terminal.run_to_the_end(cli_main)


if __name__ == "__main__":
    main()
