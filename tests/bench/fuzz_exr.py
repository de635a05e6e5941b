"""Damaged and hostile EXR files through the reader: a clear error or a right read, every time.

    python tests/bench/fuzz_exr.py                      # 20 000 files, about ten minutes on one core
    python tests/bench/fuzz_exr.py --files 100000 --seed 7 --keep findings

Whole files of every kind (scanlines, tiles, mip and rip maps, several parts, deep, subsampled; every compression that the
bindings write; structures that hypothesis makes; real frames) are damaged: bits, bytes, header values, attribute sizes, the
table of chunks, the heads of chunks, cuts, inserts, splices. A worker process reads one file after the other with a limit
on its memory (2 GB) and on its time; it is started anew when it dies. What counts as a finding:

- crash, hang, memory: the process died, took longer than 10 s, or was refused memory or grew by more than 1.5 GB;
- uncaught: an exception that is not an SvgfError;  unclear: one that does not begin with the file's name, or is endless;
- printed: anything on the standard output; on the standard error, where the library itself tells what it could not
  decode (counted as "told"), control characters;
- wrong: a read that succeeds although the file is cut off; with another shape, name or type than the header says; with other
  pixels than a plain reader (struct and zlib alone: tests/exr_files.py) finds, where it knows the compression; or with
  other pixels than before the damage, where neither pixel data, nor their size, nor what the header says of them was touched.

What nobody can notice: flipped pixels of a file without checksums that is a valid file still. Needs hypothesis.
"""

import argparse
import collections
import hashlib
import json
import os
import re
import resource
import select
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
import exr_files  # noqa: E402
from exr_damage import Base, damage  # noqa: E402

MEMORY = 2 * 2**30
GROWTH = 1.5 * 2**30
PATIENCE = 10.0
SAID = ("channels", "compression", "dataWindow", "tiles", "type")  # what says how pixels lie


# --- the worker ----------------------------------------------------------------------------------------------------


def work(limit: int, questions: int, answers: int) -> None:
    """Answer every path on one descriptor by a line of JSON on another."""
    from svgf_jax import exr, prints
    from svgf_jax.types import SvgfError

    prints.set_results_apart()
    exr._bindings()
    resource.setrlimit(resource.RLIMIT_AS, (resident("VmSize") + limit, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    replies = os.fdopen(answers, "w")
    for line in os.fdopen(questions):
        path, answer = line.strip(), {}
        Path("/proc/self/clear_refs").write_text("5")
        before, written = resident("VmRSS"), sizes()
        for name, reading in (("header", exr.read_header), ("read", exr.read)):
            try:
                answer[name] = tell(reading(path))
            except SvgfError as error:
                answer[name] = {"error": str(error)}
            except Exception as error:
                answer[name] = {"uncaught": f"{type(error).__name__}: {error}"}
        sys.stdout.flush()
        answer["printed"], answer["told"] = (now != then for now, then in zip(sizes(), written, strict=True))
        answer["growth"] = resident("VmHWM") - before
        replies.write(json.dumps(answer) + "\n")
        replies.flush()


def tell(image: Any) -> dict[str, Any]:
    channels = {}
    for name, pixels in image.channels.items():
        if isinstance(pixels, np.ndarray):
            plain = np.ascontiguousarray(pixels)
            channels[name] = (plain.dtype.name, plain.shape, hashlib.sha1(plain.tobytes()).hexdigest())
        else:
            channels[name] = (pixels.name, None, None)
    return {"channels": channels, "window": image.data_window, "display": image.display_window}


def resident(what: str) -> int:
    text = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in text.splitlines() if line.startswith(f"{what}:")))


def sizes() -> tuple[int, int]:
    return os.fstat(sys.stdout.fileno()).st_size, os.fstat(2).st_size


class Worker:
    """The process that reads; `ask` gives its answer, or how it ended."""

    def __init__(self, log: Path, limit: int):
        self.log, self.limit = log, limit
        self.start()

    def start(self) -> None:
        there, ours = os.pipe()
        back, theirs = os.pipe()
        with self.log.open("ab") as log, self.log.with_suffix(".out").open("ab") as out:
            command = [sys.executable, __file__, "--worker", *map(str, (self.limit, there, theirs))]
            self.process = subprocess.Popen(
                command, stdout=out, stderr=log, stdin=subprocess.DEVNULL, pass_fds=(there, theirs)
            )
        os.close(there)
        os.close(theirs)
        self.questions, self.answers = os.fdopen(ours, "w"), os.fdopen(back)
        self.asked = 0

    def ask(self, path: Path) -> dict[str, Any]:
        self.questions.write(f"{path}\n")
        self.questions.flush()
        patience = PATIENCE if self.asked else 60.0
        ready, _, _ = select.select([self.answers], [], [], patience)
        line = self.answers.readline() if ready else ""
        self.asked += 1
        if line:
            return json.loads(line)
        self.process.kill()
        code = self.process.wait()
        self.questions.close()
        self.answers.close()
        self.start()
        return {"ended": f"exit {code}" if ready else "hang"}


# --- whole files ---------------------------------------------------------------------------------------------------


def whole_files(folder: Path, seed: int, structures: int) -> list[Base]:
    made: list[tuple[str, bytes]] = [*by_the_library(folder), *by_hypothesis(seed, structures)]
    real = [
        *(ROOT / "tests" / "data").rglob("*.exr"),
        *sorted((ROOT / "svgf_jax" / "sample").glob("frame_000[01].exr")),
    ]
    made += [(str(path.relative_to(ROOT)), path.read_bytes()) for path in real if path.stat().st_size < 200_000]
    return [Base(name, raw, exr_files.dissect(raw)) for name, raw in made]


def by_the_library(folder: Path) -> list[tuple[str, bytes]]:
    import OpenEXR

    rng = np.random.default_rng(1)
    made = []
    compressions = [name for name in dir(OpenEXR) if name.endswith("_COMPRESSION") and not name.startswith("NUM")]

    def pixels(height: int, width: int) -> dict[str, np.ndarray]:
        smooth = np.add.outer(np.linspace(0, 3, height), np.linspace(0, 1, width))
        return {
            "R": (smooth + 0.1 * rng.random((height, width))).astype(np.float16),
            "G": smooth.astype(np.float16),
            "depth.Z": (smooth + rng.random((height, width))).astype(np.float32),
            "id": rng.integers(0, 4, (height, width)).astype(np.uint32),
        }

    def save(name: str, parts: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
        path = folder / "library.exr"
        parts = [(dict(header), channels) for header, channels in parts]  # the bindings add to what they are given
        try:
            if len(parts) == 1:
                OpenEXR.File(*parts[0]).write(str(path))
            else:
                OpenEXR.File([OpenEXR.Part(*part, f"part{i}") for i, part in enumerate(parts)]).write(str(path))
        except (RuntimeError, ValueError, TypeError) as error:
            if "deep" not in name:  # some compressions do not do it
                raise RuntimeError(f"the library does not write {name}") from error
            return
        made.append((name, path.read_bytes()))

    for compression in compressions:
        kind = {"compression": getattr(OpenEXR, compression), "type": OpenEXR.scanlineimage}
        tiles = OpenEXR.TileDescription()
        tiles.xSize, tiles.ySize = 16, 8
        tiled = kind | {"type": OpenEXR.tiledimage, "tiles": tiles}
        save(f"{compression} scanlines", [(kind, pixels(70, 21))])
        save(f"{compression} tiles", [(tiled, pixels(33, 40))])
        save(f"{compression} parts", [(dict(kind), pixels(20, 17)), (dict(tiled), pixels(20, 17))])
        corner = (np.array([-7, 5], np.int32), np.array([13, 74], np.int32))
        save(f"{compression} window", [(kind | {"dataWindow": corner, "owner": "somebody"}, pixels(70, 21))])
        deep = np.empty((4, 5), object)
        for i in range(20):
            deep.flat[i] = np.arange(i % 3 + 1, dtype=np.float32)
        save(f"{compression} deep", [(kind | {"type": OpenEXR.deepscanline}, {"Z": deep})])
    return made


def by_hypothesis(seed: int, count: int) -> list[tuple[str, bytes]]:
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded
    from hypothesis import strategies as st

    def noise(seed: int, shape: tuple[int, int], kind: np.dtype, values: int) -> np.ndarray:
        drawn = np.random.default_rng(seed).integers(0, values, shape)
        return (drawn % 60000 if kind.itemsize == 2 else drawn).astype(kind)

    corner = st.integers(-40, 40)
    names = st.sampled_from(["R", "G", "B", "Z", "a.R", "diffuse direct.R", "x" * 60, "é", "id"])
    texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20).map(str.encode)
    attributes = st.lists(
        st.one_of(
            st.tuples(st.just("owner"), st.just("string"), texts),
            st.tuples(st.just("comments"), st.just("string"), st.just(b"<b>%s{0}\x1b[31m</b>")),
            st.tuples(st.just("mine"), st.just("mytype"), st.binary(max_size=30)),
            st.tuples(st.just("worldToCamera"), st.just("m44f"), st.binary(min_size=64, max_size=64)),
        ),
        max_size=2,
        unique_by=lambda one: one[0],
    )

    @st.composite
    def files(draw: st.DrawFn) -> bytes:
        left, top = draw(corner), draw(corner)
        width, height = draw(st.integers(1, 24)), draw(st.integers(1, 40))
        display = (draw(corner), draw(corner), 40, 40)
        parts = []
        for i in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
            kinds = st.sampled_from(list(exr_files.DTYPES.values()))
            pixels = {
                name: noise(draw(st.integers(0, 2**32)), (height, width), kind, draw(st.sampled_from([1, 3, 2**31])))
                for name, kind in draw(st.dictionaries(names, kinds, min_size=1, max_size=4)).items()
            }
            parts.append(
                exr_files.Part(
                    pixels,
                    (left, top, left + width - 1, top + height - 1),
                    display,
                    draw(st.sampled_from(exr_files.COMPRESSIONS)),
                    draw(st.sampled_from(["left", "right", "<script>", "x" * 200])) + str(i),
                    draw(st.none() | st.tuples(st.integers(1, 40), st.integers(1, 40))),
                    draw(st.sampled_from(["one", "mip", "rip"])),
                    draw(st.booleans()),
                    draw(st.integers(0, 1)),
                    draw(st.sampled_from([(1, 1)] * 9 + [(2, 1), (2, 2)])),
                    tuple(draw(attributes)),
                )
            )
        return exr_files.write(parts)

    found: list[bytes] = []

    @seeded(seed)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(files())
    def collect(raw: bytes) -> None:
        found.append(raw)

    collect()
    return [(f"structure {i}", raw) for i, raw in enumerate(found)]


# --- judgement -----------------------------------------------------------------------------------------------------


def judge(raw: bytes, base: Base, path: Path, answer: dict[str, Any]) -> tuple[str, str]:
    """(verdict, why): right or refused, or one of the findings that stand at the top of this file."""
    if "ended" in answer:
        return ("hang" if answer["ended"] == "hang" else "crash"), answer["ended"]
    got, header = answer["read"], answer["header"]
    for one in (got, header):
        if "uncaught" in one:
            return "uncaught", one["uncaught"]
        text = one.get("error", "")
        if "alloc" in text or "memory" in text.lower():
            return "memory", text
        if text and (not text.startswith(str(path)) or len(text) > 2000):
            return "unclear", text[:500]
    if answer["growth"] > GROWTH:
        return "memory", f"{answer['growth'] / 2**20:.0f} MB"
    if answer["printed"]:
        return "printed", got.get("error", "")
    if "error" in got:
        return "refused", ""
    if "error" in header:
        return "wrong", f"read, but not its header: {header['error']}"
    left, top, right, bottom = got["window"]
    shapes = {tuple(shape) for _, shape, _ in got["channels"].values()}
    if shapes != {(bottom - top + 1, right - left + 1)}:
        return "wrong", f"shapes {shapes} of {got['window']}"
    if {n: kind for n, (kind, *_) in got["channels"].items()} != {
        n: kind for n, (kind, *_) in header["channels"].items()
    }:
        return "wrong", "other channels than the header's"
    pixels = tuple(sorted(digest for *_, digest in got["channels"].values()))
    try:
        plain = exr_files.read(raw)
    except NotImplementedError:
        plain = None
    except (struct.error, LookupError, ValueError, OverflowError, zlib.error) as error:
        return "wrong", f"the plain reader refuses it: {error!r}"
    if plain is not None:
        told = tuple(sorted(hashlib.sha1(own.tobytes()).hexdigest() for part in plain for own in part.values()))
        return ("right", "") if told == pixels else ("wrong", "the plain reader reads other pixels")
    if base.pixels is not None and _said(raw) == _said(base.raw) and _payload(raw, base) and pixels != base.pixels:
        return "wrong", "other pixels than before, although only other bytes were touched"
    if len(raw) < len(base.raw) and base.raw.startswith(raw):
        return "wrong", "cut off"
    return "right", ""


def _said(raw: bytes) -> Any:
    try:
        anatomy = exr_files.dissect(raw)
    except (struct.error, LookupError, ValueError, NotImplementedError):
        return None
    return [[exr_files.value(raw, part[name]) if name in part else b"" for name in SAID] for part in anatomy.attributes]


def _payload(raw: bytes, base: Base) -> bool:
    """Whether all bytes of pixel data, and their number, are where they were, as they were."""
    places = [(offset + head - 4, size + 4) for part in base.anatomy.chunks for offset, head, size in part]
    return len(raw) == len(base.raw) and all(raw[at : at + n] == base.raw[at : at + n] for at, n in places)


def keep(folder: Path | None, finding: tuple[str, str, str, bytes], number: int) -> None:
    where, verdict, why, raw = finding
    print(f"{verdict}: {where}: {why[:300]}", flush=True)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        safe = "".join(c if c.isalnum() else "-" for c in where)[:80]
        (folder / f"{verdict}-{number}-{safe}.exr").write_bytes(raw)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--structures", type=int, default=300, help="how many whole files hypothesis makes")
    parser.add_argument("--keep", type=Path, help="a folder for the files that are findings")
    parser.add_argument("--worker", type=int, nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return work(*options.worker)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        worker, path = Worker(folder / "log", MEMORY), folder / "case.exr"
        bases, findings = [], []
        for base in whole_files(folder, options.seed, options.structures):
            path.write_bytes(base.raw)
            answer = worker.ask(path)
            verdict, why = judge(base.raw, base, path, answer)
            if verdict not in ("right", "refused"):
                findings.append((f"whole file {base.name}", verdict, why, base.raw))
                keep(options.keep, findings[-1], len(findings))
            pixels = None
            if "channels" in answer.get("read", {}):
                pixels = tuple(sorted(digest for *_, digest in answer["read"]["channels"].values()))
            bases.append(base._replace(pixels=pixels))
        readable = sum(base.pixels is not None for base in bases)
        print(f"{len(bases)} whole files, {readable} of them readable; damaging {options.files}", flush=True)
        verdicts: collections.Counter[str] = collections.Counter()
        growth, slowest, told = 0, 0.0, 0
        for i in range(options.files):
            rng = np.random.default_rng((options.seed, i))
            base, other = (bases[rng.integers(len(bases))] for _ in range(2))
            raw, how = damage(base, other, rng)
            path.write_bytes(raw)
            start = time.monotonic()
            answer = worker.ask(path)
            slowest = max(slowest, time.monotonic() - start)
            growth = max(growth, answer.get("growth", 0))
            verdict, why = judge(raw, base, path, answer)
            verdicts[verdict] += 1
            told += answer.get("told", False)
            if verdict not in ("right", "refused"):
                findings.append((f"{options.seed}/{i} {base.name} {how}", verdict, why, raw))
                keep(options.keep, findings[-1], len(findings))
            if (i + 1) % 2000 == 0:
                print(f"{i + 1}: {dict(verdicts)}, {time.monotonic() - began:.0f} s", flush=True)
        worker.process.kill()
        if odd := re.findall(rb".{0,80}[\x00-\x09\x0b-\x1f\x7f].{0,80}", (folder / "log").read_bytes()):
            findings.append(("the standard error", "printed", repr(odd[:3]), b""))
            keep(options.keep, findings[-1], len(findings))
    counted = ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items()))
    print(
        f"{options.files} files, seed {options.seed}: {counted}; told {told}; at most {growth / 2**20:.0f} MB for a file, ",
        end="",
    )
    print(f"{slowest:.2f} s; {time.monotonic() - began:.0f} s in all")
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
