"""Graphs of ROS 2 for one test each."""

import os
import time

import pytest


@pytest.fixture
def ros(monkeypatch):
    """A graph of this test and its processes alone, on this computer."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (os.getpid() + time.monotonic_ns()) % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
