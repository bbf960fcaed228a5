"""How long do the import and the first compiled step take?

Each measurement is a separate process without a compilation cache; the kinds are measured alternately.
"""

import argparse
import os
import statistics
import subprocess
import sys

KINDS = {
    "import jax, flax.struct": "import jax, flax.struct",
    "import jaxdrones": "import jaxdrones",
    "first step after the import": """
import jaxdrones as jd
params, step = jd.repeat(jd.load_params("cf2x"), 1), jd.make_step(effects=(jd.drag,))
state = jd.State.at_rest([[0, 0, 1]])
start = time.perf_counter()
step(params, state, state.rpm).pos.block_until_ready()""",
}
TEMPLATE = "import time; start = time.perf_counter()\n{}\nprint(time.perf_counter() - start)"
UNWANTED = ("gymnasium", "brax", "pybullet", "matplotlib")


def run(code: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    return done.stdout


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeats", type=int, default=9)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    times = {kind: [] for kind in KINDS}
    for _ in range(1 if options.quick else options.repeats):
        for kind, code in KINDS.items():
            times[kind].append(float(run(TEMPLATE.format(code))))
    medians = {kind: statistics.median(values) for kind, values in times.items()}
    ratio = medians["import jaxdrones"] / medians["import jax, flax.struct"]
    loaded = run(f"import sys, jaxdrones; print(*[name for name in {UNWANTED} if name in sys.modules])").split()
    lines = []
    lines += [f"{value:7.2f} s  {kind}" for kind, value in medians.items()]
    lines += [
        f"{ratio:7.2f}    import jaxdrones over import jax, flax.struct",
        f"optional libraries loaded: {loaded or 'none'}",
    ]
    return {"seconds": medians, "import ratio": ratio, "loaded": loaded}, lines
