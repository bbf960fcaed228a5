"""Recorded cases are chosen by what their sidecars say."""

import json
import shutil

import golden_data
import numpy as np
import pytest

import jaxdrones

KINDS = {  # what tests ask for, of which the bundled folder has some
    "flight": ((), dict(kind="open_loop_rollout", physics="dyn", variant="main")),
    "allocation": (("infeasible",), {}),
    "episode": ((), dict(kind="rl_episode")),
}


def copy(name, folder, new, **changes):
    """A bundled case under another name, with changes to its sidecar."""
    shutil.copy(golden_data.BUNDLED / f"{name}.npz", folder / f"{new}.npz")
    about = json.loads((golden_data.BUNDLED / f"{name}.json").read_text())
    (folder / f"{new}.json").write_text(json.dumps(about | changes))


@pytest.mark.parametrize("kind", KINDS)
def test_names_of_files_do_not_matter(kind, tmp_path, monkeypatch):
    arrays, about = KINDS[kind]
    for i, other in enumerate(KINDS):
        copy(golden_data.select(golden_data.BUNDLED, *KINDS[other])[0], tmp_path, f"pyb_paper_{i}")
    monkeypatch.setattr(golden_data, "FOLDER", tmp_path)
    (name,) = golden_data.names(*arrays, **about)
    assert name == f"pyb_paper_{list(KINDS).index(kind)}"
    assert golden_data.load(name).arrays


def test_a_sidecar_must_say_all_that_is_asked(tmp_path):
    (name, *_) = golden_data.select(golden_data.BUNDLED, *KINDS["flight"])
    copy(name, tmp_path, "one", vehicle="hb", decimation=25)
    for about, fits in (
        (dict(vehicle="hb"), True),
        (dict(vehicle=("cf2x", "hb")), True),
        (dict(vehicle="cf2x"), False),
        (dict(decimation=None), False),
        (dict(speed_limit=None), True),
        (dict(physics=lambda physics: physics.startswith("pyb")), False),
        (dict(speed_limit=float), False),
    ):
        assert golden_data.select(tmp_path, ("pos",), about) == (["one"] if fits else [])
    assert golden_data.select(tmp_path, ("no such array",), {}) == []


def test_a_kind_that_is_missing_is_an_error_here_and_skipped_with_its_reason_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setattr(golden_data, "FOLDER", golden_data.BUNDLED)
    with pytest.raises(FileNotFoundError, match=r"no case with arrays .*no such"):
        golden_data.names("no such")
    monkeypatch.setattr(golden_data, "FOLDER", tmp_path)
    (parameter,) = golden_data.names("pos")
    assert "has no case" in parameter.marks[0].kwargs["reason"]


def test_clipped_flights_are_commanded_to_our_motors_and_others_fly_as_recorded():
    case = golden_data.Case({"rpm_applied": np.full((2, 1, 4), 1e4)}, {})
    params = jaxdrones.load_params("cf2x")
    unlimited, rpm = golden_data.flown(case, params)
    assert np.isinf(unlimited.max_rpm) and rpm is case.arrays["rpm_applied"]
    beyond = case.arrays | {"rpm_cmd": 3 * rpm}
    limited, rpm = golden_data.flown(case._replace(arrays=beyond), params)
    assert limited is params and rpm is beyond["rpm_cmd"]
