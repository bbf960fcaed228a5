"""Fine-tunes the policy for any vehicle: longer trajectories, longer delays, and more light vehicles.

A window of one second is too short to see that a vehicle of some kilograms oscillates; in one of two seconds the
lightest vehicles with the longest delays, of which few are drawn, are lost instead.
"""

import dataclasses
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxdrones as jd
from jaxdrones.envs.observations import last_actions
from jaxdrones.envs.randomize import AnyVehicle
from jaxdrones.learning import bptt, evaluate
from jaxdrones.learning.adaptive import OBSERVED
from jaxdrones.params import Params
from jaxdrones.training.plan import REPORT_STREAM
from jaxdrones.training.presets import preset
from jaxdrones.training.run import Run, report_as_dict

SHARE, HEAVIEST = 0.2, 0.04  # additional share of light vehicles, and their largest mass, kg
DELAY = 0.0, 0.05  # s
CONFIG = dict(
    updates=600,
    worlds=256,
    horizon=192,
    hidden_sizes=(16,),
    recurrent_size=13,
    learning_rate=5e-4,
    restart_fraction=0.4,
    obs_stats_freeze=0.0,
    outlier_gradient=30.0,  # without it the policy is lost within 600 updates
    max_grad_norm=10.0,
    adam_b2=0.999,
)


@dataclasses.dataclass(frozen=True)
class MoreLightVehicles(AnyVehicle):
    """Any vehicle, or one of at most `HEAVIEST` in an additional share of the episodes."""

    def __call__(self, key: jax.Array, params: Params) -> Params:
        """Random vehicle, with gravity, air and wind of `params`."""
        any_key, light_key, share_key = jax.random.split(key, 3)
        light = jax.random.bernoulli(share_key, SHARE)
        drawn = AnyVehicle()(any_key, params), AnyVehicle(heaviest=HEAVIEST)(light_key, params)
        return jax.tree.map(lambda one, other: jnp.where(light, other, one), *drawn)


def fine_tune(run: Path, folder: Path, seed: int = 0) -> None:
    """Train the best policy of a finished run on, and write it to a folder with its evaluation."""
    key, began = jax.random.key(seed), time.perf_counter()
    flown = preset("hover", "bptt", realistic="any")[0]
    practice = {"randomize": [MoreLightVehicles()], "delay": DELAY}
    observed = {"action": "throttle", "observation": (*OBSERVED, last_actions(1))}
    env = jd.make("hover", realistic=True, **practice, **observed)
    policy, config = Run(run).policy(), bptt.Config(**CONFIG)
    state = bptt.init(key, env, config, None)
    tuned = bptt.train(key, env, config, state=state.replace(policy=policy)).policy
    seconds = time.perf_counter() - began
    report = json.loads((run / "report.json").read_bytes())
    episodes = report["episodes"]
    report["evaluation"] = report_as_dict(evaluate(flown, tuned, jax.random.fold_in(key, REPORT_STREAM), episodes))
    report["seconds"]["fine-tuning"] = seconds
    about = {"fine_tuned": CONFIG | {"seed": seed, "share": SHARE, "heaviest": HEAVIEST, "delay": DELAY}}
    sidecar = json.loads((run / "best.json").read_bytes())
    kept = {name: sidecar[name] for name in ("run_id", "recipe", "seed", "episodes", "update")}
    Run(folder).save_policy("best", tuned, **kept, **about)  # the recipe is that of the first training
    (folder / "report.json").write_text(json.dumps(report | about))
