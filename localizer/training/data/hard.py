"""Pairs that the network still gets wrong, of which a share of each later batch is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Key = tuple[str, int]  # name of a shard, and which of its pairs
State = dict[str, list[list[object]]]


@dataclass(frozen=True)
class HardShare:
    """share: of the samples, drawn from hard pairs; ranks: which pairs are hard, as shares of all
    that were seen, the worst first (the very worst often show nothing that could be matched);
    every_steps: how often the list is made again.
    """

    share: float
    ranks: tuple[float, float]
    every_steps: int


class HardPairs:
    """Remembers how well each pair was aligned, and lists the hard ones.

    A list that is made when step `s` is due holds from `s + 1` on: the batch of `s` is already
    being prepared then. So what a step sees does not depend on the machine's speed, and with the
    state of a checkpoint a run goes on exactly.
    """

    def __init__(self, config: HardShare) -> None:
        self._config = config
        self._errors: dict[Key, float] = {}
        self._lists: tuple[tuple[int, tuple[Key, ...]], ...] = ()

    def draw(self, step: int, rng: np.random.Generator) -> Key | None:
        """A hard pair for one sample of a step; None where any pair will do."""
        lists = [keys for made, keys in self._lists if made < step]
        if not lists or not lists[-1] or rng.random() >= self._config.share:
            return None
        return lists[-1][int(rng.integers(len(lists[-1])))]

    def note(self, step: int, keys: Sequence[Key], errors: Sequence[float]) -> None:
        """The errors of a step's samples; the newest counts half."""
        for key, error in zip(keys, errors, strict=True):
            self._errors[key] = 0.5 * (self._errors.get(key, error) + error)
        if (step + 1) % self._config.every_steps == 0:
            self._lists = (*self._lists[-1:], (step + 1, self._hard()))

    def state(self) -> State:
        """What a checkpoint keeps."""
        return {
            "errors": [[*key, error] for key, error in self._errors.items()],
            "lists": [[made, [list(key) for key in keys]] for made, keys in self._lists],
        }

    def restore(self, state: State) -> None:
        """Go on from `state`; TypeError or ValueError when it is not one."""
        self._errors = {(name, k): error for name, k, error in state["errors"]}  # type: ignore[misc]
        self._lists = tuple(
            (made, tuple((name, k) for name, k in keys))  # type: ignore[misc, attr-defined]
            for made, keys in state["lists"]
        )

    def _hard(self) -> tuple[Key, ...]:
        ordered = sorted(self._errors, key=lambda key: (-self._errors[key], key))
        first, last = (round(rank * len(ordered)) for rank in self._config.ranks)
        return tuple(ordered[first:last])
