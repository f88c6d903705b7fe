"""Writes and reads checkpoints of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from localizer.errors import ModelError


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Replace the checkpoint atomically; `ModelError` if that fails, with the old one unchanged."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    try:
        torch.save(dict(state), partial)
        partial.replace(path)
    except (OSError, RuntimeError) as error:  # torch's own of a full disk
        partial.unlink(missing_ok=True)
        why = str(error).split("\n")[0]
        raise ModelError(
            f"{path}: cannot be written, is the disk full? {why}; an older one is kept"
        ) from error


def read_checkpoint(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint's state of a `Trainer`; `ModelError` for another file."""
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # pickle's and zip's errors are many
        why = str(error).split("\n")[0]
        raise ModelError(f"{path}: not a readable checkpoint: {why}") from error
    if not isinstance(state, dict) or not isinstance(state.get("average"), dict):
        raise ModelError(f"{path}: not a checkpoint of this training: holds no averaged weights")
    return state


def load_weights(network: nn.Module, weights: Mapping[str, Any], path: Path) -> None:
    """Load checkpoint weights into a network. `ModelError`, with `path` in its text, if they are
    another network's.
    """
    try:
        network.load_state_dict(weights)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise ModelError(
            f"{path}: its weights are of another network than the configuration's `model`"
        ) from error
