"""Clients of the simulated Crazyflie by cflib, run in its own environment; each prints JSON."""

import json
import sys
import time

import cflib.crtp
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import MemoryElement, Poly4D
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.positioning.motion_commander import MotionCommander
from cflib.utils.reset_estimator import reset_estimator


def read_and_set(cf):
    """Tables, a parameter that is set, and the states of the supervisor."""
    before = cf.param.get_value("pid_rate.roll_kp")
    cf.param.set_value("pid_rate.roll_kp", 240.5)
    cf.param.set_value("commander.enHighLevel", 1)
    defaults = []
    cf.param.get_default_value("pid_rate.roll_kp", lambda name, value: defaults.append(value))
    time.sleep(0.5)
    return {
        "parameters": sum(map(len, cf.param.toc.toc.values())),
        "variables": sum(map(len, cf.log.toc.toc.values())),
        "before": before,
        "after": cf.param.get_value("pid_rate.roll_kp"),
        "default": defaults,
        "states": cf.supervisor.read_state_list(),
        "protocol": cf.platform.get_protocol_version(),
    }


def log(cf):
    """Two log blocks of 20 and 100 ms for three seconds."""
    rows = {20: [], 100: []}
    for period in rows:
        config = LogConfig(f"every {period} ms", period)
        config.add_variable("stateEstimate.z", "float")
        config.add_variable("acc.z", "FP16")
        config.add_variable("pm.vbatMV", "uint16_t")
        cf.log.add_config(config)
        config.data_received_cb.add_callback(lambda t, data, c, rows=rows[period]: rows.append((t, *data.values())))
        config.start()
    time.sleep(3)
    return {"rows": list(rows.values())}


def square(cf):
    """Square of 0.5 m by the MotionCommander."""
    cf.supervisor.send_arming_request(True)
    with MotionCommander(cf, default_height=0.4) as commander:
        time.sleep(1)
        for _ in range(4):
            commander.forward(0.5, velocity=0.4)
            time.sleep(1)
            commander.turn_left(90)
            time.sleep(0.5)
    time.sleep(1)
    return {}


def high_level(cf):
    """Take-off, two positions, an uploaded trajectory, and a landing by the high-level commander."""
    reset_estimator(cf)
    memory = cf.mem.get_mems(MemoryElement.TYPE_TRAJ)[0]
    memory.trajectory = [Poly4D(2.0, x=Poly4D.Poly([0.0, 0.2] + [0.0] * 6))]  # 0.2 m/s along x for 2 s
    assert memory.write_data_sync()
    cf.high_level_commander.define_trajectory(1, 0, 1)
    fly = cf.high_level_commander
    fly.takeoff(1.0, 2.0)
    time.sleep(3)
    fly.go_to(0.5, -0.5, 1.2, 1.0, 2.0)
    time.sleep(3)
    fly.start_trajectory(1, 1.0, relative_position=True)
    time.sleep(4)
    flying = cf.supervisor.read_state_list()
    fly.land(0.0, 2.0)
    time.sleep(3)
    return {"flying": flying, "landed": cf.supervisor.read_state_list()}


if __name__ == "__main__":
    cflib.crtp.init_drivers()
    with SyncCrazyflie(sys.argv[2], cf=Crazyflie()) as connected:
        connected.wait_for_params()
        print(json.dumps(globals()[sys.argv[1]](connected.cf)))
