"""`python -m svgf_jax` and the `svgf-jax` command."""


def main() -> None:
    """Run the command line."""
    from svgf_jax.cli import main as cli_main

    cli_main()


if __name__ == "__main__":
    main()
