"""Policies with random weights, and programs that run their exported files."""

import ctypes
import json
import math
import re
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.learning.layers import make_network
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import RunningStatistics

COMPILE = ("cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-O2")
STEPS, DRONES = 6, 16  # of the sequences with which programs are compared

_DRIVER = """
#include "NAME.h"
void reset(float *hidden);
void reset(float *hidden)
{
    RESET;
}
void run(int steps, int drones, INPUTS, float *act);
void run(int steps, int drones, INPUTS, float *act)
{
    (void)hidden;
    for (int t = 0; t < steps; ++t)
        for (int i = 0; i < drones; ++i) {
            const int k = t * drones + i;
            NAME_step(ADVANCE);
        }
}
"""
_NODE = """
import * as policy from "PATH";
let text = "";
for await (const part of process.stdin) text += part;
const inputs = JSON.parse(text, (_, x) => (x === null ? Infinity : x));
const act = inputs.obs.map((rows) => rows.map(() => null));
for (let i = 0; i < inputs.obs[0].length; ++i) {
  const hidden = policy.initialHiddenState ? [policy.initialHiddenState()] : [];
  for (let t = 0; t < inputs.obs.length; ++t) {
    act[t][i] = Array.from(policy.step(...Object.values(inputs).map((x) => x[t][i]), ...hidden));
  }
}
console.log(JSON.stringify(act));
"""


def random_policy(
    env, hidden_sizes=(9, 7), recurrent_size=0, activation="tanh", per_agent=False, set_sizes=(8, 6)
) -> Policy:
    """Policy with random weights and statistics, whose actions are neither near zero nor saturated."""
    rng = np.random.default_rng(0)
    obs = {"state": jnp.zeros(env.observation_size)}
    obs |= {name: jnp.zeros(space.shape, space.dtype) for name, space in env.image_spaces.items()}
    obs = obs if env.image_spaces else obs["state"]
    network = make_network(obs, hidden_sizes, env.action_size, 1.0, recurrent_size, env.sets, set_sizes)
    network = network.clone(activation=activation)
    shapes = jax.eval_shape(network.init, jax.random.key(0), obs)
    team = (env.drones,) if per_agent else ()

    def weights(shape):
        fan_in = shape.shape[0] if shape.ndim > 1 else 4
        return jnp.asarray(rng.normal(size=team + shape.shape) * 0.7 / np.sqrt(fan_in), jnp.float32)

    mean, var = rng.normal(size=env.observation_size), rng.uniform(0.0, 2.0, env.observation_size)
    var[0] = 1e-9  # below the lower bound
    stats = RunningStatistics(jnp.asarray(mean, jnp.float32), jnp.asarray(var, jnp.float32), jnp.float32(100))
    return Policy(jax.tree.map(weights, shapes), stats, network, per_agent).with_obs_stats(stats)


def random_inputs(env, seed=1) -> dict[str, np.ndarray]:
    """Observations (steps, drones, d) and images of many drones; some entries are far from the mean."""
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(STEPS, DRONES, env.observation_size))
    obs[:, ::3, ::4] *= 20
    inputs = {"obs": obs.astype(np.float32)}
    for name, space in sorted(env.image_spaces.items()):
        shape = (STEPS, DRONES, *space.shape)
        inputs[name] = rng.uniform(-0.1, 8, shape) if name == "depth" else rng.integers(0, 256, shape)
        inputs[name] = inputs[name].astype(space.dtype)
    if "depth" in inputs:
        inputs["depth"][0, 0, 0] = np.inf
    return inputs


def expected_actions(policy: Policy, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """Actions (steps, drones, a) of `Policy.act`, one observation after the other."""
    hidden_state = policy.initial_hidden_state((inputs["obs"].shape[1],))
    act, actions = jax.jit(policy.act), []
    for t in range(len(inputs["obs"])):
        obs = {"state" if name == "obs" else name: jnp.asarray(x[t]) for name, x in inputs.items()}
        hidden_state, action = act(hidden_state, obs if len(obs) > 1 else obs["state"])
        actions.append(np.asarray(action))
    return np.stack(actions)


class CompiledPolicy:
    """Policy of a C header, called in a library; also a recurrent policy for `jaxdrones.learning.evaluate`."""

    def __init__(self, header: Path, warn: bool = True):
        """Compile a header; warnings are errors, or else ignored."""
        name = header.stem
        defined = re.findall(rf"#define {name.upper()}_(\w+)_SIZE (\d+)", header.read_text())
        self.sizes = {key.lower(): int(size) for key, size in defined}
        self.action_size, self.hidden_size = self.sizes.pop("act"), self.sizes.pop("hidden", 0)
        kinds = {key: "const uint8_t" if key == "rgb" else "const float" for key in self.sizes}
        advance = [f"{key} + k * {size}" for key, size in self.sizes.items()]
        advance += [f"hidden + i * {self.hidden_size}"] * (self.hidden_size > 0) + [f"act + k * {self.action_size}"]
        texts = {
            "INPUTS": "".join(f"{kind} *{key}, " for key, kind in kinds.items()) + "float *hidden",
            "ADVANCE": ", ".join(advance),
            "RESET": f"{name}_reset(hidden)" if self.hidden_size else "(void)hidden",
            "NAME": name,
        }
        driver = _DRIVER
        for key, text in texts.items():
            driver = driver.replace(key, text)
        source, library = header.with_suffix(".c"), header.with_suffix(".so")
        source.write_text(driver)
        command = COMPILE if warn else (*COMPILE, "-w", "-O0")
        subprocess.run([*command, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
        self.library = ctypes.CDLL(str(library))

    def reset(self, drones: int) -> np.ndarray:
        """Hidden states (drones, size) at the start of flights."""
        one = np.full(max(1, self.hidden_size), np.nan, np.float32)
        self.library.reset(_address(one))
        return np.tile(one, (drones, 1))

    def run(self, inputs: dict[str, np.ndarray], hidden: np.ndarray) -> np.ndarray:
        """Actions (steps, drones, a) of inputs (steps, drones, ...); changes the hidden states."""
        steps, drones = inputs["obs"].shape[:2]
        act = np.empty((steps, drones, self.action_size), np.float32)
        arrays = [np.ascontiguousarray(inputs[key]) for key in self.sizes]
        self.library.run(steps, drones, *map(_address, (*arrays, hidden, act)))
        return act

    def initial_hidden_state(self, batch: tuple[int, ...]) -> jax.Array:
        """Zeros."""
        return jnp.zeros((*batch, max(1, self.hidden_size)), jnp.float32)

    def act(self, hidden_state: jax.Array, obs: Any) -> tuple[jax.Array, jax.Array]:
        """Hidden states and actions of the drones of a team, or of many teams."""

        def host(hidden_state: Any, obs: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
            shape, hidden = np.shape(hidden_state)[:-1], np.array(hidden_state, np.float32)
            rows = {
                key: np.asarray(x).reshape(1, math.prod(shape), *np.shape(x)[len(shape) :]) for key, x in obs.items()
            }
            return hidden, self.run(rows, hidden).reshape(*shape, self.action_size)

        named = (
            {"obs" if key == "state" else key: x for key, x in obs.items()} if isinstance(obs, dict) else {"obs": obs}
        )
        action = jax.ShapeDtypeStruct((*hidden_state.shape[:-1], self.action_size), jnp.float32)
        state = jax.ShapeDtypeStruct(hidden_state.shape, hidden_state.dtype)
        return jax.pure_callback(host, (state, action), hidden_state, named, vmap_method="broadcast_all")


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def actions_of_c(file: Path, inputs: dict[str, np.ndarray], warn: bool = True) -> np.ndarray:
    policy = CompiledPolicy(file, warn)
    return policy.run(inputs, policy.reset(inputs["obs"].shape[1]))


def actions_of_js(file: Path, inputs: dict[str, np.ndarray]) -> np.ndarray:
    """Actions in Node.js; JSON has no infinity, which is sent as null."""
    lists = {name: x.reshape(*x.shape[:2], -1).tolist() for name, x in inputs.items()}
    text = json.dumps(lists).replace("Infinity", "null")
    code = _NODE.replace("PATH", file.absolute().as_uri())
    command = ["node", "--input-type=module", "-e", code]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    return np.array(json.loads(done.stdout), np.float32)


def actions_of_onnx(file: Path, inputs: dict[str, np.ndarray]) -> np.ndarray:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    sizes = {x.name: x.shape[1:] for x in session.get_inputs()}
    state = {
        name: np.zeros((inputs["obs"].shape[1], *size), np.float32)
        for name, size in sizes.items()
        if name == "hidden_state"
    }
    actions = []
    for t in range(len(inputs["obs"])):
        action, *next_state = session.run(None, {name: x[t] for name, x in inputs.items()} | state)
        state = dict(zip(state, next_state, strict=True))
        actions.append(action)
    return np.stack(actions)


def actions_of_stablehlo(file: Path, inputs: dict[str, np.ndarray]) -> np.ndarray:
    exported = jax.export.deserialize(bytearray(file.read_bytes()))
    (arguments, _) = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    state = [np.zeros((inputs["obs"].shape[1], *x.shape[1:]), np.float32) for x in arguments[len(inputs) :]]
    actions = []
    for t in range(len(inputs["obs"])):
        action = exported.call(*(x[t] for x in inputs.values()), *state)
        if state:
            action, *state = action
        actions.append(np.asarray(action))
    return np.stack(actions)


RUN = {"c": actions_of_c, "js": actions_of_js, "onnx": actions_of_onnx, "stablehlo": actions_of_stablehlo}
SUFFIX = {"c": "h", "js": "js", "onnx": "onnx", "stablehlo": "stablehlo"}
