"""Policies as C, ONNX, StableHLO and JavaScript, for use without this library."""

from jaxdrones.export.files import TARGETS, Exported, save

__all__ = ["TARGETS", "Exported", "save"]
