"""How much does an exported policy differ from the original, how long does a call take, and does it fly as well?

The bundled policies of `hover` (MLP), `forest` (CNN) and `crowd` (team, with a set of drones) and a recurrent one for
`recovery`, which is trained here, are compared on the observations of flights of 32 drones; the recurrent one keeps its
hidden state for a whole flight. The result is the largest difference of any action, with a range of -1 to 1; `float64`
is the difference of the policy from itself in float64. The code size is that of `cc -Os` without the weights, and the
time is that of a call in C. Whole evaluations are flown with the policy and with its C function.
"""

import argparse
import dataclasses
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks import exported
from jaxdrones.envs import Env
from jaxdrones.export import Exported, save
from jaxdrones.learning import bptt, evaluate
from jaxdrones.learning.networks import Policy
from jaxdrones.training.presets import preset

BUNDLED = ("hover", "forest", "crowd")
RECURRENT = "recovery"
NAMES = {"c": "C", "js": "JavaScript", "onnx": "ONNX", "stablehlo": "StableHLO", "float64": "float64"}
QUICK = {"updates": 2, "worlds": 4, "horizon": 4}
_DRONES, _CALLS = 32, 20_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--episodes", type=int, default=1000, help="of an evaluation (1000)")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    pilots = [(name, jd.make(name), jd.make_policy(name)) for name in (BUNDLED[:1] if options.quick else BUNDLED)]
    env, config = preset(RECURRENT, "bptt")
    config = dataclasses.replace(config, recurrent_size=32, **QUICK if options.quick else {})
    pilots.append((f"{RECURRENT}, GRU", env, bptt.train(jax.random.key(0), env, config).policy))
    episodes = 10 if options.quick else options.episodes
    rows = [{"policy": name} | row(env, policy, episodes) for name, env, policy in pilots]
    return {"rows": rows}, [line for each in rows for line in text(each)]


def row(env: Env, policy: Policy, episodes: int) -> dict:
    """Costs and differences of one policy, and the success of both."""
    inputs = flown(env, policy)
    expected = exported.expected_actions(policy, inputs)
    with tempfile.TemporaryDirectory() as folder:
        files: dict[str, Exported] = {to: save(policy, env, to, folder)[0] for to in exported.RUN}
        found = {to: exported.RUN[to](one.files[0], inputs) for to, one in files.items()}
        in_c = exported.CompiledPolicy(files["c"].files[0])
        code = code_size(files["c"].files[0])
    costs = {name: getattr(files["c"], name) for name in ("multiply_adds", "flash", "ram")}
    result = costs | {"code": code, "observations": inputs["obs"].shape[0] * inputs["obs"].shape[1]}
    if policy.is_recurrent:
        result["one call"] = one_call(policy, in_c, inputs)
    found["float64"] = in_float64(policy, inputs)
    result["differences"] = {to: float(np.abs(actions - expected).max()) for to, actions in found.items()}
    result["microseconds"] = microseconds(in_c, inputs)
    reports = [evaluate(env, each, jax.random.key(1), episodes) for each in (policy, in_c)]
    return result | {"episodes": episodes, "success": [report.success for report in reports]}


def one_call(policy: Policy, in_c: exported.CompiledPolicy, inputs: dict[str, np.ndarray]) -> float:
    """Largest difference of any action in C, if every call starts from the hidden state of the policy."""
    act, hidden_state, worst = jax.jit(policy.act), policy.initial_hidden_state((inputs["obs"].shape[1],)), 0.0
    for obs in inputs["obs"]:
        actions = in_c.run({"obs": obs[None]}, np.array(hidden_state))[0]
        hidden_state, expected = act(hidden_state, obs)
        worst = max(worst, float(np.abs(actions - expected).max()))
    return worst


def in_float64(policy: Policy, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """Actions of the policy in float64."""
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), policy)
        floats = {name: x if x.dtype == np.uint8 else x.astype(np.float64) for name, x in inputs.items()}
        return exported.expected_actions(wide, floats)


def flown(env: Env, policy: Policy) -> dict[str, np.ndarray]:
    """Observations and images (steps, drones, ...) of flights of 32 drones by a policy."""

    def flight(key: jax.Array) -> jax.Array:
        def control_step(carry, key):
            hidden_state, obs, world = carry
            hidden_state, action = policy.act(hidden_state, obs)
            return (hidden_state, *env.step(key, world, action)[:2]), obs

        start, *keys = jax.random.split(key, 1 + env.steps)
        carry = (policy.initial_hidden_state((env.drones,)), *env.reset(start))
        return jax.lax.scan(control_step, carry, jnp.stack(keys))[1]

    obs = jax.jit(jax.vmap(flight))(jax.random.split(jax.random.key(2), _DRONES // env.drones))
    images = dict(obs) if isinstance(obs, dict) else {"state": obs}
    named = {"obs": images.pop("state")} | images  # in the order of the arguments
    return {
        name: np.ascontiguousarray(np.moveaxis(np.asarray(x), 0, 1).reshape(x.shape[1], -1, *x.shape[3:]))
        for name, x in named.items()
    }


def microseconds(policy: exported.CompiledPolicy, inputs: dict[str, np.ndarray]) -> float:
    """Duration of a call in C, the best of three runs."""
    calls = inputs["obs"].shape[0] * inputs["obs"].shape[1]
    repeats, times = max(1, _CALLS // calls), []
    for _ in range(3):
        hidden, start = policy.reset(inputs["obs"].shape[1]), time.perf_counter()
        for _ in range(repeats):
            policy.run(inputs, hidden)
        times.append((time.perf_counter() - start) / repeats / calls)
    return 1e6 * min(times)


def code_size(header: Path) -> int:
    """Bytes of machine code that the compiler makes of a header, from its symbols."""
    source, made = header.with_name("size.c"), header.with_name("size.o")
    lines = ["void *used(void);", "void *used(void) {", f"    return (void *){header.stem}_step;", "}"]
    source.write_text("\n".join([f'#include "{header.name}"', *lines, ""]))
    subprocess.run(["cc", "-std=c99", "-Os", "-c", str(source), "-o", str(made)], check=True)
    done = subprocess.run(["nm", "--size-sort", "-t", "d", str(made)], capture_output=True, text=True, check=True)
    return sum(
        int(size) for size, kind, name in map(str.split, done.stdout.splitlines()) if kind in "tT" and name != "used"
    )


def text(row: dict) -> list[str]:
    lines = [f"{row['policy']}: {row['multiply_adds']:,} multiply-adds, {row['microseconds']:.1f} us per call in C"]
    lines.append(f"  bytes: {row['flash']:,} of weights, {row['code']:,} of code, {row['ram']:,} of RAM")
    worst = ", ".join(f"{NAMES[to]} {x:.1e}" for to, x in row["differences"].items())
    lines.append(f"  largest difference over {row['observations']:,} observations: {worst}")
    if "one call" in row:
        lines.append(
            f"  largest difference if every call in C starts from the policy's hidden state: {row['one call']:.1e}"
        )
    policy, in_c = (f"{100 * x:.1f} %" for x in row["success"])
    return [*lines, f"  success over {row['episodes']:,} episodes: {policy}, in C {in_c}"]
