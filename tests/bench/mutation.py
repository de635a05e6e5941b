"""Which small changes of the stages do the tests not notice? Mutants of nine files, drawn at random, each run against the tests.

A mutant is one file with one change: an operator, a comparison, a number, a condition (operators of cosmic-ray, which this needs:
`pip install cosmic-ray`), or of what JAX code is made of (maximum for minimum, the branches of `where` exchanged, floor for ceil,
all for any, an `abs`, a cast or a clip left out). At each place of the code one mutant of each kind is drawn; annotations,
defaults and text are left alone. The code of the loaded functions is exchanged in place, so that every test sees the mutant
whatever it imported, and the changed text lies in a copy of the tree, for the tests that start a process.

    python tests/bench/mutation.py --of-each 40 --seed 1 --log mutants.jsonl          # the campaign; goes on where the log ends
    python tests/bench/mutation.py --of-each 40 --seed 1 --log mutants.jsonl --again  # those that survived, by the tests of now
    python tests/bench/mutation.py --log mutants.jsonl --tell                          # what survived

Tests run in the order below, those of the file first, each in a process that is used again; the first failure kills. A test that
takes more than LIMIT_S seconds of processor time is a kill too.
"""

import argparse
import ast
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from types import FunctionType, ModuleType

ROOT = Path(__file__).parents[2]
LIMIT_S = 60
STAGES = "tests/test_stages_oracle.py::test_"
FOLLOWED = "tests/test_adaptation.py::test_"
# For each file: its tests, the quickest and most telling first.
TESTS = {
    "color": [f"{STAGES}luminance", f"{STAGES}demodulate", f"{STAGES}remodulate", "tests/test_color.py"],
    "sampling": [
        "tests/test_strips.py",
        f"{STAGES}atrous_level[0]",
        f"{STAGES}reproject",
        f"{STAGES}estimate_variance",
        f"{STAGES}the_plain",
        f"{STAGES}depth_gradient",
        "tests/test_devices.py::test_rows",
    ],
    "reprojection": [f"{STAGES}reproject", "tests/test_reflections.py::test_the_history"],
    "accumulation": [
        f"{STAGES}accumulate",
        "tests/test_reflections.py::test_a_history",
        "tests/test_measured_variance.py::test_measured_variances_against",
        "tests/test_measured_variance.py::test_where",
        "tests/test_measured_variance.py::test_a_nearly",
        "tests/test_measured_variance.py::test_measured_variances_have",
    ],
    "variance": [
        f"{STAGES}estimate_variance",
        f"{STAGES}variance",
        "tests/test_measured_variance.py::test_measured_variances_against",
        "tests/test_measured_variance.py::test_a_frame",
        "tests/test_gradients.py::test_forward_is_reverse_is_finite_differences[short",
    ],
    "atrous": [f"{STAGES}atrous", f"{STAGES}feedback", f"{STAGES}the_plain", f"{STAGES}backs"],
    "adaptation": [
        "tests/test_light_mutants.py::test_by_hand",
        f"{FOLLOWED}the_stage",
        f"{FOLLOWED}without",
        f"{FOLLOWED}it_is_diff",
    ],
    "significance": [
        "tests/test_light_mutants.py::test_by_hand",
        f"{FOLLOWED}the_stage",
        f"{FOLLOWED}the_effective",
        f"{FOLLOWED}it_is_diff",
    ],
    "cells": ["tests/test_light_mutants.py::test_by_hand", f"{FOLLOWED}the_stage"],
    "reflections": ["tests/test_light_mutants.py::test_by_hand", "tests/test_reflections.py"],
}
# Asked of all, last: the whole.
WHOLE = "tests/test_pipeline_oracle.py::test_"
LAST = [f"{STAGES}step", "tests/test_outliers.py::test_remove", f"{WHOLE}synthetic", f"{WHOLE}real_crop_float64"]
OTHER = {"maximum": "minimum", "minimum": "maximum", "floor": "ceil", "any": "all", "all": "any"}
OTHER |= {"zeros_like": "ones_like", "ones_like": "zeros_like", "zeros": "ones", "exp": "abs"}


def fixed_places(tree: ast.AST) -> list[tuple[int, int]]:
    """Lines and columns, as (line, column) ranges, of annotations, defaults, decorators and checks."""
    nodes = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            nodes += [*node.args.defaults, *node.args.kw_defaults, node.returns, *node.decorator_list]
        if isinstance(node, ast.arg | ast.AnnAssign):
            nodes.append(node.annotation)
        if isinstance(node, ast.keyword) and node.arg in (
            "strict",
            "prevent_cse",
        ):  # checks; what is stored: no numbers
            nodes.append(node.value)
    return [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in nodes if n is not None]


def changed_at(old: str, new: str) -> tuple[int, int]:
    """Line and column of the first difference."""
    for line, (a, b) in enumerate(zip(old.splitlines(), new.splitlines(), strict=False), 1):
        if a != b:
            return line, next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
    return 0, 0


def swaps(text: str, tree: ast.AST) -> list[tuple[str, str]]:
    """(kind, changed text) of the calls that JAX code is made of."""
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node) -> tuple[int, int]:
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    def replaced(node, by: str) -> str:
        start, end = span(node)
        return text[:start] + by + text[end:]

    def source(node) -> str:
        return text[slice(*span(node))]

    found = []
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        name, arguments = node.func.attr, node.args
        if name in OTHER:
            changed = f"{source(node.func).removesuffix(name)}{OTHER[name]}"
            found.append(("call", replaced(node.func, changed)))
        if name == "where" and len(arguments) == 3:
            test, one, other = map(source, arguments)
            found.append(("branches", replaced(node, f"{source(node.func)}({test}, {other}, {one})")))
        if name in ("abs", "clip", "sqrt", "concatenate", "floor") and arguments:
            found.append(("left out", replaced(node, source(arguments[0]))))
        if name == "astype":
            found.append(("left out", replaced(node, source(node.func.value))))
    return found


def kind_of(name: str) -> str | None:
    """The kind of an operator of cosmic-ray; None: makes nothing but errors, or the same as another."""
    name = name.removeprefix("core/")
    arithmetic, bits = {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}, {"BitOr", "BitAnd"}
    if name.startswith("ReplaceBinaryOperator"):
        _, old, new = name.split("_")
        return "binary" if {old, new} <= arithmetic or {old, new} <= bits else None
    if name.startswith("ReplaceComparisonOperator"):
        return None if "Is" in name else "comparison"
    if name in (
        "ReplaceUnaryOperator_Delete_USub",
        "ReplaceUnaryOperator_Delete_Invert",
        "ReplaceUnaryOperator_Delete_Not",
    ):
        return "unary"
    kinds = {"AddNot": "condition", "ReplaceTrueWithFalse": "truth", "ReplaceFalseWithTrue": "truth"}
    kinds |= {
        "ReplaceAndWithOr": "logic",
        "ReplaceOrWithAnd": "logic",
        "NumberReplacer": "number",
        "ZeroIterationForLoop": "loop",
    }
    return kinds.get(name)


def mutants_of(text: str, draw: random.Random) -> list[tuple]:
    """One mutant of each kind at each place: (kind, line, column, what makes the changed text)."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code

    tree, places = ast.parse(text), {}
    for kind, new in swaps(text, tree):
        places.setdefault((kind, changed_at(text, new)), []).append(partial(str, new))
    nodes = list(ast_nodes(get_ast(text)))
    for name in cosmic_ray.plugins.operator_names():
        if kind := kind_of(name):
            operator = cosmic_ray.plugins.get_operator(name)()
            found = [start for node in nodes for start, _ in operator.mutation_positions(node)]
            for i, start in enumerate(found):
                places.setdefault((kind, start), []).append(partial(mutate_code, text, operator, i))
    fixed = fixed_places(tree)
    return [
        (kind, *at, draw.choice(makers))
        for (kind, at), makers in sorted(places.items(), key=lambda place: place[0])
        if not any(start <= at < end for start, end in fixed)
    ]


def parses(text: str) -> bool:
    """Whether a text is a program."""
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True


def drawn(of_each: int, seed: int, only: list[str]) -> list[dict]:
    """The sample: so many of each file, all in one random order."""
    draw, chosen = random.Random(seed), []
    for name in only:
        text = (ROOT / "svgf_jax" / f"{name}.py").read_text(encoding="utf-8")
        found = mutants_of(text, draw)
        print(f"{name}: {len(found)} mutants", flush=True)
        for kind, line, column, make in draw.sample(found, min(of_each, len(found))):
            new = make()
            if not parses(new):
                continue  # no mutant: the bare `*` of a signature multiplies nothing
            was, now = (lines.splitlines()[line - 1].strip() for lines in (text, new))
            chosen.append(
                {"file": name, "kind": kind, "line": line, "column": column, "was": was, "is": now, "text": new}
            )
    draw.shuffle(chosen)
    return chosen


class Exchange:
    """Puts a changed text in the place of a module, in memory and in the copy of the tree."""

    def __init__(self, name: str, text: str):
        import importlib

        self.module = importlib.import_module(f"svgf_jax.{name}")
        self.path, self.text, self.kept = Path(self.module.__file__), text, {}

    def __enter__(self):
        self.old = self.path.read_text(encoding="utf-8")
        self.path.write_text(self.text, encoding="utf-8")
        new = ModuleType(self.module.__name__)
        exec(compile(self.text, str(self.path), "exec"), new.__dict__)
        for name, value in vars(new).items():
            own = vars(self.module).get(name)
            if name.startswith("__") or isinstance(own, ModuleType | type):
                continue
            if isinstance(own, FunctionType):
                if own.__module__ == self.module.__name__:
                    self.kept[name] = own.__code__
                    own.__code__ = value.__code__
            else:
                self.kept[name] = own
                setattr(self.module, name, value)

    def __exit__(self, *_):
        self.path.write_text(self.old, encoding="utf-8")
        for name, value in self.kept.items():
            own = vars(self.module)[name]
            if isinstance(own, FunctionType):
                own.__code__ = value
            else:
                setattr(self.module, name, value)


class Runner:
    """A plugin of pytest that runs the collected tests once for each mutant that comes in on a pipe."""

    def __init__(self, orders, answers):
        self.orders, self.answers, self.why = orders, answers, ""

    def pytest_collection_modifyitems(self, items):
        self.items = items

    def pytest_runtestloop(self, session):
        import jax
        from _pytest.runner import runtestprotocol

        def first_failure(tests) -> str | None:
            import gc

            import bridge

            bridge.jitted.cache_clear()
            jax.clear_caches()
            for item in tests:
                signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
                item._initrequest()
                reports = runtestprotocol(item, nextitem=None, log=False)
                signal.setitimer(signal.ITIMER_PROF, 0)
                if bad := [report for report in reports if report.failed]:
                    self.why = str(bad[0].longrepr)[-600:]
                    return item.nodeid
            gc.collect()
            return None

        for line in self.orders:
            mutant = json.loads(line)
            started, failed = time.process_time(), None
            wanted = [
                *(test for name in mutant.get("only") or [mutant["file"]] for test in TESTS[name]),
                *LAST,
            ]
            tests = list(dict.fromkeys(i for test in wanted for i in self.items if i.nodeid.startswith(test)))
            if "file" in mutant:
                try:
                    with Exchange(mutant["file"], mutant["text"]):
                        failed = first_failure(tests)
                except Exception as error:
                    failed = f"import: {type(error).__name__}"
            else:
                failed = first_failure(tests)
            answer = {"by": failed, "seconds": round(time.process_time() - started, 1), "why": failed and self.why}
            self.answers.write(json.dumps(answer) + "\n")
            self.answers.flush()
        return True


def work(tree: Path, orders: int, answers: int) -> None:
    """The process that runs the tests, in the copy of the tree."""
    import pytest

    os.chdir(tree)
    sys.path.insert(0, str(tree))
    resource.setrlimit(resource.RLIMIT_AS, (12 * 2**30, 12 * 2**30))
    files = sorted({test.split("::")[0] for tests in (*TESTS.values(), LAST) for test in tests})
    files = [file for file in files if Path(file).exists()]
    runner = Runner(os.fdopen(orders), os.fdopen(answers, "w"))
    pytest.main(["-p", "no:cacheprovider", "-q", "--tb=no", *files], plugins=[runner])


class Worker:
    """The process that runs the tests; started anew when it hangs or dies."""

    def __init__(self, tree: Path):
        self.tree, self.process = tree, None

    def start(self):
        orders, self.orders = os.pipe()
        self.answers, answers = os.pipe()
        environment = os.environ | {"PYTHONPATH": str(self.tree), "PYTHONDONTWRITEBYTECODE": "1"}
        call = [sys.executable, str(Path(__file__).absolute()), "--work", str(self.tree), str(orders), str(answers)]
        self.process = subprocess.Popen(
            call, env=environment, pass_fds=(orders, answers), stdout=subprocess.DEVNULL, start_new_session=True
        )
        os.close(orders)
        os.close(answers)
        self.reading, self.writing = os.fdopen(self.answers), os.fdopen(self.orders, "w")

    def ask(self, mutant: dict) -> dict:
        if self.process is None or self.process.poll() is not None:
            self.start()
        self.writing.write(json.dumps(mutant) + "\n")
        self.writing.flush()
        answer = self.reading.readline()  # ends when the process does: its own timer sees to that
        if not answer:
            self.process.wait()
            return {"by": "time, memory or crash", "seconds": None}
        return json.loads(answer)

    def end(self):
        self.writing.close()
        self.process.wait()


def key(mutant: dict) -> tuple:
    return tuple(mutant[name] for name in ("file", "kind", "line", "column", "is"))


def logged(log: Path) -> dict[tuple, dict]:
    """What a log holds of each mutant, the latest."""
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return {key(mutant): mutant for mutant in map(json.loads, lines)}


def campaign(of_each: int, seed: int, log: Path, *, again: bool, only: list[str]) -> None:
    """Run what the log does not hold yet; `again`: only what it holds as survived."""
    done = logged(log)
    survived = {known for known, mutant in done.items() if mutant["by"] is None}
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
        for name in files:
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
        worker = Worker(tree)
        answer = worker.ask({"only": only})
        print("unchanged:", answer, flush=True)
        assert answer["by"] is None, "the tests fail without any mutant"
        for mutant in drawn(of_each, seed, only):
            text = mutant.pop("text")
            if key(mutant) not in survived if again else key(mutant) in done:
                continue
            answer = worker.ask({**mutant, "text": text})
            with log.open("a") as file:
                file.write(json.dumps({**mutant, **answer}) + "\n")
        worker.end()


def tell(log: Path) -> None:
    """Killed and survived of each file, and the survivors."""
    done = list(logged(log).values())
    for name in TESTS:
        own = [m for m in done if m["file"] == name]
        killed = sum(m["by"] is not None for m in own)
        print(f"{name}: {killed} of {len(own)} killed")
    for m in sorted(done, key=lambda m: (m["file"], m["line"])):
        if m["by"] is None:
            print(f"\n{m['file']}.py:{m['line']} ({m['kind']})\n  was {m['was']}\n  is  {m['is']}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--of-each", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=TESTS, default=list(TESTS))
    parser.add_argument("--log", type=Path, default=Path("mutants.jsonl"))
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--tell", action="store_true")
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.work:
        work(Path(chosen.work[0]), *map(int, chosen.work[1:]))
    elif chosen.tell:
        tell(chosen.log)
    else:
        campaign(chosen.of_each, chosen.seed, chosen.log, again=chosen.again, only=chosen.only)
