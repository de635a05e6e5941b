"""`python -m svgf_jax` and the `svgf-jax` command."""


def main() -> None:
    """Run the command line."""
    from svgf_jax import prints
    from svgf_jax.cli import main as cli_main

    prints.set_results_apart()
    cli_main()


if __name__ == "__main__":
    main()
