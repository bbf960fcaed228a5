# %% [markdown]
# # Does it fly like a Crazyflie?
# Two recorded flights of a real Crazyflie 2.1 come with the package; they are from NanoBench (Ullah and Baca 2026,
# arXiv 2603.09908, BSD-3). One is used to identify the vehicle, the other one to test how well the simulation
# reproduces a flight that was not fitted.

# %%
# Installs the package where it is missing, from the checkout with this notebook. Elsewhere, as on Colab, set PACKAGE
# to the path of a wheel, "jaxdrones-VERSION-py3-none-any.whl[cli]", or to "jaxdrones[cli] @ git+https://REPOSITORY".
import importlib.util
import subprocess
import sys

PACKAGE = "..[cli]"
if importlib.util.find_spec("jaxdrones") is None:
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", PACKAGE], check=True)

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.cli.score import closed_loop_table, open_loop_table
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.flights import (
    HORIZONS,
    Vehicle,
    errors_as_dict,
    fit,
    hold_errors,
    load_flights,
    open_loop_errors,
    simulate_closed_loop,
)
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# ## The recordings
# The log has Vicon's position, attitude and velocity, the gyroscope, the PWM of the motors, the voltage of the battery
# and the set-points, at 100 Hz. The firmware's PID flew the drone; rotor speeds were not measured.

# %%
# The first identifies the vehicle, the second scores it.
told, kept = load_flights("B10_lissajous_slow_rep1", "B3_figure8_slow_rep2")

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.2), dpi=80, layout="constrained")
for axis, log, use in (left, told, "to identify"), (middle, kept, "to score"):
    axis.plot(*log.target_pos[:, 0, :2].T, color="grey", linewidth=1, label="set-points")
    axis.plot(*log.pos[:, 0, :2].T, label="flown")
    axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{use}: {log.name.split('_')[1]}")
middle.legend(loc="lower center", bbox_to_anchor=(0.5, 1.25), ncols=2, fontsize="small")
left.set_xticks([-0.5, 0, 0.5])
right.plot(kept.t, kept.pwm.mean(axis=(1, 2)) / 65535, label="mean PWM, share of the time")
right.plot(kept.t, kept.vbat / 4.2, label="voltage over 4.2 V")
right.set(xlabel="t (s)", ylim=(0, 1.1), title="motors and battery")
right.legend(loc="lower center", fontsize="small")
print(f"{kept.name}: {len(kept.t)} rows, {kept.t[-1] - kept.t[0]:.0f} s, at most {np.abs(kept.vel).max():.1f} m/s")

# %% [markdown]
# ## Vehicles with published parameters
# *Open loop*: from every state of the log, the model is simulated with the recorded PWM and voltage of the next half
# second. The table has the mean errors. *Hold* is a model with a constant state. `cf2x` has the parameters of Panerati
# et al. 2021, `cf21` those of a later identification of the same vehicle with the propellers of these flights
# (crazyflow).

# %%
motors, gains = crazyflie_motors("2.1+"), firmware_pid.gains(propellers="2.1+")
LABELS = {"pieces": "fitted to pieces", "path": "fitted to a path"}
vehicles = {name: Vehicle.of(jd.load_params(name)) for name in ("cf2x", "cf21")}


def open_loop(log):
    """Open-loop errors by model: arrays (horizons, 4)."""
    return {"hold": hold_errors(log)} | {name: open_loop_errors(log, v, motors) for name, v in vehicles.items()}


print(open_loop_table({name: errors_as_dict(e) for name, e in open_loop(kept).items()}))

# %% [markdown]
# After half a second the errors of both are larger than those of *hold*. There is no controller in open loop: errors
# of a percent in the four thrusts make a drone of 30 g rotate at several rad/s within that time. The actual thrust of
# the real drone's motors, relative to the firmware's curve and to each other, is unknown.

# %% [markdown]
# ## Identification from a flight
# The vehicle is simulated over windows of half a second (`pieces` below), each from its logged initial state. The
# Gauss-Newton method minimizes the differences from the log over 14 parameters, with the derivative of the simulation
# with respect to all of them. The standard errors assume independent residuals.

# %%
NAMES = ("mass", "km", "drag_coeff_x", "drag_coeff_y", "flapping_coeff", "inertia_x", "inertia_y", "rate_damping")
NAMES += ("center_of_mass", "trim_torque_z", "delay")
began = time.perf_counter()
report = fit([told], jd.load_params("cf2x"), NAMES)
print(f"fitted in {time.perf_counter() - began:.0f} s, compilation included")
for name, estimate in report.parameters.items():
    print(f"{name:18} {estimate.value:10.3g} +- {estimate.std_error:.1g}")
vehicles["pieces"] = report.vehicle

# %% [markdown]
# The vehicle is scored on the other flight, which was not fitted.

# %%
errors = open_loop(kept)
titles = "position (m)", "velocity (m/s)", "attitude (rad)", "rates (rad/s)"
figure, axes = plt.subplots(1, 4, figsize=(11, 3.2), dpi=80, layout="constrained")
for i, (axis, title) in enumerate(zip(axes, titles, strict=True)):
    for (name, table), color in zip(errors.items(), ("grey", *COLORS), strict=False):
        axis.plot(np.array(HORIZONS) / 100, table[:, i], "o-", color=color, label=LABELS.get(name, name))
    axis.set(xlabel="after (s)", yscale="log", title=title)
figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize="small")
print(open_loop_table({"hold": errors_as_dict(errors["hold"]), "pieces": errors_as_dict(errors["pieces"])}))
assert (errors["pieces"][-1, [0, 1, 3]] < errors["hold"][-1, [0, 1, 3]]).all()

# %% [markdown]
# ## Simulation of the whole flight
# *Closed loop*: the only inputs of the firmware's PID are the logged set-points and the logged voltage. Now a
# controller corrects the errors of the model, so the flight identifies other parameters. The ratio of thrust to mass
# follows from the balance of vertical forces. Drag, flapping, rotor lag and the scale of the tilt in the drone's state
# estimate are fitted to the path, with the derivative of the whole flight.

# %%
began = time.perf_counter()
report = fit([told], jd.load_params("cf2x"))
print(f"fitted in {time.perf_counter() - began:.0f} s, compilation included")
for name, estimate in report.parameters.items():
    print(f"{name:18} {estimate.value:10.3g} +- {estimate.std_error:.1g}")
vehicles["path"] = report.vehicle

# %%
twins = {name: simulate_closed_loop(kept, vehicle, motors, gains) for name, vehicle in vehicles.items()}
print(closed_loop_table({name: [twin.as_dict()] for name, twin in twins.items()}))

shown = {name: twins[name] for name in ("cf2x", "path")}
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8), dpi=80, layout="constrained", width_ratios=(1.3, 1))
left.plot(*twins["cf2x"].ref_pos[:, :2].T, "--", color="grey", linewidth=1, label="set-points")
left.plot(*twins["cf2x"].pos[:, :2].T, color="black", label="flown")
for color, (name, twin) in zip(COLORS, shown.items(), strict=False):
    left.plot(*twin.sim_pos[:, :2].T, color=color, label=f"simulated, {LABELS.get(name, name)}")
    right.plot(twin.t - twin.t[0], 100 * np.linalg.norm(twin.sim_pos - twin.pos, axis=1), color=color)
left.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="figure eight, from above")
figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize="small")
right.set(xlabel="t (s)", ylabel="distance from the flight (cm)", ylim=(0, None), title="how far apart")
assert twins["path"].as_dict()["xy_rms_m"] < twins["cf2x"].as_dict()["xy_rms_m"]

# %% [markdown]
# ## Limits of the agreement
# - **No vehicle is best in both tests.** The vehicle fitted to half-second windows without a controller has an inertia
#   that is more than ten times too large, and a correspondingly large damping: thrust errors of a percent rotate a
#   model with the true inertia, so a slow model has the smallest errors. With the PID it oscillates and climbs away.
#   The attitude of the vehicle fitted to the path diverges within a quarter of a second without a controller.
# - **Rotor speeds were not measured.** PWM and voltage determine the thrust only to within a few percent, with
#   differences from flight to flight. With the measured rotor speeds of faster flights, the error after half a second
#   is 9 cm, and that of *hold* 41 cm (docs/reality.md).
# - **The mass is estimated as 44 g**, for a drone of 27 g with its markers. A flight identifies only the ratio of
#   thrust to mass: the actual thrust is lower than that of the firmware's curve.
# - **The recording.** The drone's own state estimate and Vicon differ by 2 to 4 cm, which no vehicle explains.
#
# `jaxdrones score` and `jaxdrones fit` do the same with your flights.
