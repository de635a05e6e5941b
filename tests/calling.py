"""The command line in processes of its own, and what is measured of them."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
SEARCHED = f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'offline'}"  # without a network
COMMANDS = """
import json, sys, time
from pathlib import Path
for arguments in json.load(sys.stdin):
    began = time.process_time()
    sys.argv = ['svgf-jax', *arguments]
    from svgf_jax.__main__ import main
    try:
        main()
    except SystemExit as end:
        code = end.code
    heavy = sorted({name.split('.')[0] for name in sys.modules} & {'jax', 'jaxlib'})
    found = sorted(map(str, Path().rglob('*')))
    print('TELL', json.dumps([code, time.process_time() - began, heavy, found]), file=sys.stderr)
"""
PRELUDE = """
import atexit, resource, sys
def tell():
    use = resource.getrusage(resource.RUSAGE_SELF)
    heavy = sorted({name.split('.')[0] for name in sys.modules} & {'jax', 'jaxlib', 'numpy', 'rich'})
    print('TELL', use.ru_utime + use.ru_stime, *heavy, file=sys.stderr)
atexit.register(tell)
sys.argv[0] = 'svgf-jax'
from svgf_jax.__main__ import main
main()
"""


def command(*arguments, cwd=None, under=()):
    """Run `svgf-jax` in a process of its own, `under` another command."""
    environment = os.environ | {"PYTHONPATH": SEARCHED, "COLUMNS": "100"}
    call = [*under, sys.executable, "-m", "svgf_jax", *map(str, arguments)]
    return subprocess.run(call, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)


def observed(*arguments, cwd=None):
    """(exit code, standard error, processor seconds, heavy modules imported) of a command."""
    environment = os.environ | {"PYTHONPATH": SEARCHED}
    call = [sys.executable, "-c", PRELUDE, *map(str, arguments)]
    done = subprocess.run(call, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)
    error, _, told = done.stderr.rpartition("TELL ")
    seconds, *modules = told.split()
    return done.returncode, error, float(seconds), set(modules)


def seconds_to_import(module):
    """Processor seconds of a Python that does nothing else."""
    code = f"import time, {module}; print(time.process_time())"
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
