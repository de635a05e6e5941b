"""Install the package as its users do, each time in a fresh environment, and use it from a folder outside the checkout.

    python tests/bench/install.py wheel sdist lowest

`wheel` and `sdist` build and install these with the newest dependencies; `lowest` installs the wheel with the oldest versions that
pyproject.toml allows, which needs `uv`. Each must hold every file of the packages that git knows, answer `--help`, and denoise two
frames of the bundled sample; `lowest` also runs the tests of files, commands and stages. Needs a package index.
"""

import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
QUICK_TESTS = [
    *("api", "exr", "sequences", "params_command", "project", "parameters", "checkpoint", "renderers", "tev", "roles"),
    *(
        "cameras",
        "frames",
        "inspect",
        "report",
        "metrics",
        "stages_oracle",
        "strips",
        "tune_fold",
        "cli",
        "demo",
        "docs",
    ),
    *("tune_fit", "tune_faults", "dry_run", "readme", "preview"),
]


def run(*call, cwd=None, **environment) -> str:
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(list(map(str, call)), cwd=cwd, env=kept | environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, call))}\n{done.stdout}\n{done.stderr}")
    return done.stdout


def built(folder: Path) -> dict[str, Path]:
    """A wheel and a source archive."""
    run(sys.executable, "-m", "venv", folder / "build")
    run(folder / "build/bin/pip", "install", "-q", "build")
    run(folder / "build/bin/python", "-m", "build", "--outdir", folder / "dist", ROOT)
    (wheel,), (sdist,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    return {"wheel": wheel, "sdist": sdist, "lowest": wheel}


def check_files(wheel: Path) -> None:
    """Every file of the packages is in the wheel."""
    tracked = run("git", "ls-files", "svgf_jax", "tune", cwd=ROOT).split()
    missing = set(tracked) - set(zipfile.ZipFile(wheel).namelist())
    assert not missing, missing
    print(f"wheel: {wheel.stat().st_size / 1e6:.1f} MB, all {len(tracked)} files of the packages", flush=True)


def check_use(python: Path, folder: Path) -> None:
    """The commands work where no checkout is."""
    folder.mkdir()
    where = run(python, "-c", "import svgf_jax; print(svgf_jax.__file__)", cwd=folder).strip()
    assert str(python.parents[1]) in where, where
    for call in (("svgf-jax", "demo", "--help"), ("svgf-tune", "--help"), ("svgf-jax", "params", "show")):
        assert run(python.parent / call[0], *call[1:], cwd=folder)
    sample = run(python, "-c", "import svgf_jax; print(svgf_jax.sample())", cwd=folder).strip()
    run(
        python.parent / "svgf-jax",
        "denoise",
        sample,
        "-o",
        "out",
        "--frames",
        "0-1",
        "--report",
        "page.html",
        cwd=folder,
    )
    assert sorted(path.name for path in (folder / "out").glob("*.exr")) == ["frame_0000.exr", "frame_0001.exr"]


def main(kinds: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        archives = built(folder)
        check_files(archives["wheel"])
        for kind in kinds:
            environment, archive = folder / kind, archives[kind]
            run(sys.executable, "-m", "venv", environment)
            python = environment / "bin/python"
            if kind == "lowest":
                run(environment / "bin/pip", "install", "-q", "uv")
                uv = [
                    environment / "bin/uv",
                    "pip",
                    "install",
                    "-q",
                    "--python",
                    python,
                    "--resolution",
                    "lowest-direct",
                ]
                run(*uv, f"{archive}[test]")
            else:
                run(environment / "bin/pip", "install", "-q", archive)
            check_use(python, folder / f"use-{kind}")
            print(f"{kind}: installed and used", flush=True)
            if kind == "lowest":
                tests = [f"tests/test_{test}.py" for test in QUICK_TESTS]
                print(
                    run(python, "-m", "pytest", "-p", "no:cacheprovider", *tests, cwd=ROOT, PYTHONPATH=str(ROOT)),
                    flush=True,
                )


if __name__ == "__main__":
    main(sys.argv[1:] or ["wheel", "sdist", "lowest"])
