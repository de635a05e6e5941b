"""Each of the tuner's default numbers alone, found again in data that the filter itself made with it.

python tests/bench/recover_each.py        (the default tests do three of them, and these three together)
"""

import sys
from pathlib import Path

import jax

sys.path.insert(0, str(Path(__file__).parents[1]))
jax.config.update("jax_enable_x64", True)

from test_tune_fit import CONFIG, TERMS, TRUE, shot  # noqa: E402

import tune  # noqa: E402
from tune.free import TUNED_BY_DEFAULT  # noqa: E402


def main() -> None:
    wrong = []
    for name in TUNED_BY_DEFAULT:
        truth = getattr(TRUE, name)
        start = TRUE._replace(**{name: 0.7 if name.startswith("alpha") else 1.8 * truth})
        fit = tune.fit(start, CONFIG, [shot()], TERMS, names=[name], least_gain=0)
        found = getattr(fit.params, name)
        print(
            f"{name:16} {truth:.6g} from {getattr(start, name):.6g}: {found:.6g} in {len(fit.iterations)} trials",
            flush=True,
        )
        if abs(found / truth - 1) > 1e-3:
            wrong.append(name)
    if wrong:
        sys.exit(f"not found again: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
