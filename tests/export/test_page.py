"""The commands and programs of docs/export.md run."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from documents import ROOT, blocks

from jaxdrones.cli import main

PAGE = ROOT / "docs" / "export.md"
SHORT = "--set worlds=8 --set horizon=4 --budget 2 --episodes 8 --no-figure"


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.needs("onnx", "onnxruntime", "flatbuffers")
@pytest.mark.skipif(not (shutil.which("cc") and shutil.which("node")), reason="cc or node is not installed")
def test_what_is_on_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(PAGE, "text"):
        if name := re.match(r"(?:/\*|//) ([\w.]+)", block.code):
            Path(name[1]).write_text(block.code)
    printed = []
    for line in (line for block in blocks(PAGE, "sh") for line in block.code.splitlines()):
        if line.startswith("jaxdrones "):
            more = SHORT if " train " in line else ""
            assert main([*line.removeprefix("jaxdrones ").split(), *more.split()]) == 0
        else:
            printed.append(subprocess.run(line, shell=True, capture_output=True, text=True, check=True).stdout)
    assert {file.name for file in Path("exported").iterdir()} >= {"policy.h", "policy.js", "policy.onnx", "policy.json"}
    names: dict = {}
    for block in blocks(PAGE, "python"):
        exec(compile(block.code, str(PAGE), "exec"), names)
    assert names["act"].shape == (1000, 4) and "stablehlo" in names["text"]
    in_c, in_js = (np.array(re.findall(r"-?\d\.\d+(?:e-?\d+)?", text), float) for text in printed)
    obs = np.zeros((1, 22), np.float32)
    obs[0, [2, 3, 7, 11]] = 0.5, 1, 1, 1
    expected = np.asarray(names["policy"].call(obs))[0]
    np.testing.assert_allclose(in_c, expected, atol=1e-5)  # prints six decimals
    np.testing.assert_allclose(in_js, expected, atol=1e-5)
