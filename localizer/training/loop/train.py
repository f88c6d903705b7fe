"""The training loop: both losses together, EMA, exact resumption."""

from __future__ import annotations

import csv
import importlib
import logging
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from localizer.errors import ModelError
from localizer.training.checkpoint import load_weights, read_checkpoint, write_checkpoint
from localizer.training.config import OptimizerSection, TrainConfig
from localizer.training.data.batches import open_stream
from localizer.training.losses import Batch, alignment_loss, contrast_loss, sample, se3_exp
from localizer.training.models.networks import build

# torch's optimizers import Triton. Its LLVM and that of Mesa's software OpenGL, which the renderer
# of pairs may load, end the process with a segmentation fault if Mesa's is loaded first.
with suppress(ImportError):
    importlib.import_module("triton")

_log = logging.getLogger(__name__)


class Trainer:
    """A training run that can be stopped and resumed at any step with the same result. It continues
    from its checkpoint if there is one.

    Under torchrun every process takes its own batches and all take the mean step; the first process
    writes the files. Batch statistics are not averaged; the first process's are kept.
    """

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        torch.manual_seed(config.seed)
        torch.set_num_threads(config.optimizer.threads)
        self.workers = TrainingProcess.from_environment()
        self.device = self.workers.device
        self.model = build(config.model).to(self.device).train()
        if config.warm_start is not None:
            first = read_checkpoint(config.warm_start, self.device)
            load_weights(self.model, first["average"], config.warm_start)
        self.average = build(config.model).to(self.device).eval()
        self.average.load_state_dict(self.model.state_dict())
        self.log_scale = nn.Parameter(
            torch.full((len(self.model.strides),), 3.2, device=self.device)
        )
        self.optimizer = torch.optim.AdamW(
            [
                {"params": list(self.model.parameters())},
                {"params": [self.log_scale], "weight_decay": 0.0},
            ],
            lr=config.optimizer.learning_rate,
            weight_decay=config.optimizer.weight_decay,
        )
        self.step = 0
        self.seconds = self.core_seconds = 0.0  # by the clock, and of the processor
        self._resume()

    @property
    def checkpoint(self) -> Path:
        """Path of the run's newest checkpoint."""
        return self.config.output / f"{self.config.name}.pt"

    def run(self, steps: int | None = None, generating: Future[None] | None = None) -> None:
        """Train up to the configured number of steps, or `steps` more, and write checkpoints.

        generating: generation of shards in parallel; its failure ends the run.
        """
        last = self.config.optimizer.steps
        if steps is not None:
            last = min(last, self.step + steps)
        self.config.output.mkdir(parents=True, exist_ok=True)  # its error now, not after hours
        stream = open_stream(self.config, self.workers.rank, self.workers.count, generating)
        rows: list[dict[str, float]] = []
        began = time.monotonic() - self.seconds
        core_began = time.process_time() - self.core_seconds
        try:
            while self.step < last:
                rows.append(self._train_step(stream.batch(self.step)))
                self.step += 1
                self.seconds = time.monotonic() - began
                self.core_seconds = time.process_time() - core_began
                self._save(at_the_end=self.step == last)
                if self.step % 25 == 0 or self.step == last:
                    self._log(rows)
                    rows = []
        finally:
            stream.close()

    def _train_step(self, batch: Batch) -> dict[str, float]:
        o = self.config.optimizer
        batch = Batch(*(t.to(self.device) for t in vars(batch).values()))
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.step, o)
        loss, parts = self._loss(batch)
        self.optimizer.zero_grad()
        loss.backward()
        parameters = [*self.model.parameters(), self.log_scale]
        self.workers.average_gradients(parameters)
        norm = nn.utils.clip_grad_norm_(parameters, 5.0)
        if torch.isfinite(norm):
            self.optimizer.step()
            self._update_average()
        else:
            _log.warning("step %d skipped: gradient is not finite", self.step)
        return parts | {"loss": float(loss.detach()), "gradient": float(norm)}

    def _loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """The loss and its parts."""
        o = self.config.optimizer
        pairs = batch.points.shape[0]
        with torch.autocast(self.device.type, torch.bfloat16, enabled=o.mixed_precision):
            levels = self.model(batch.images.contiguous())
        ramp = alignment_ramp(self.step, o)
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        total, parts = batch.points.new_zeros(()), {}
        strides = self.model.strides
        for k, ((features, confidence), stride) in enumerate(zip(levels, strides, strict=True)):
            at = batch.reference_pixels / stride
            anchors = sample(features[:pairs], at)
            trust = sample(confidence[:pairs, None], at)[..., 0]
            query = features[pairs:]
            contrast = contrast_loss(
                anchors, query, batch.query_pixels / stride, batch.visible,
                self.log_scale[k].exp(), 64, o.whole_map_cells,
            )  # fmt: skip
            start = perturbed_poses(batch, o.start_error_px[k], generator)
            alignment, error = alignment_loss(
                batch, (anchors, trust), (query, confidence[pairs:]), stride, start,
                o.lm_iterations,
            )  # fmt: skip
            total = total + o.contrast_weight * contrast
            total = total + ramp * o.alignment_weight * alignment
            parts[f"contrast_{k}"] = float(contrast.detach())
            parts[f"alignment_{k}"] = float(alignment.detach())
            parts[f"error_px_{k}"] = float(error.mean())
        return total, parts

    def _update_average(self) -> None:
        decay = min(self.config.optimizer.ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, value in zip(
                self.average.state_dict().values(), self.model.state_dict().values(), strict=True
            ):
                if mean.is_floating_point():
                    mean.lerp_(value, 1 - decay)
                else:
                    mean.copy_(value)

    def _save(self, *, at_the_end: bool) -> None:
        due = at_the_end or self.step % self.config.checkpoint_steps == 0
        if self.workers.rank > 0 or not due:
            return
        state = {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "log_scale": self.log_scale.detach(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "core_seconds": self.core_seconds,
            "config": self.config.model_dump(mode="json"),
        }
        write_checkpoint(self.checkpoint, state)

    def _resume(self) -> None:
        if not self.checkpoint.exists():
            return
        state = read_checkpoint(self.checkpoint, self.device)
        try:
            load_weights(self.model, state["model"], self.checkpoint)
            load_weights(self.average, state["average"], self.checkpoint)
            with torch.no_grad():
                self.log_scale.copy_(state["log_scale"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.step, self.seconds = int(state["step"]), float(state["seconds"])
            self.core_seconds = float(state.get("core_seconds", self.seconds))
        except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            raise ModelError(
                f"{self.checkpoint}: no state to continue from ({type(error).__name__}: {error}); "
                "weights alone go into `warm_start`"
            ) from error
        _log.info("resumed %s at step %d", self.checkpoint, self.step)

    def _log(self, rows: list[dict[str, float]]) -> None:
        if self.workers.rank > 0:
            return
        means: dict[str, float] = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
        spent = {"seconds": round(self.seconds, 1), "core_seconds": round(self.core_seconds, 1)}
        row = {"step": float(self.step)} | spent | means
        append(self.config.output / f"{self.config.name}.csv", row)
        shown = " ".join(f"{k} {v:.3g}" for k, v in row.items())
        _log.info("%s", shown)


def learning_rate(step: int, o: OptimizerSection) -> float:
    """Linear warm-up, a plateau, a cosine to zero over the last `decay_steps`. step: from 0."""
    warm = min(1.0, (step + 1) / max(o.warmup_steps, 1))
    left = min(1.0, (o.steps - step) / o.decay_steps)
    return float(o.learning_rate * warm * 0.5 * (1 - np.cos(np.pi * left)))


def alignment_ramp(step: int, o: OptimizerSection) -> float:
    """Share of Eq. 3's weight at a step: 0 before `alignment_first_step`, then rising to 1."""
    since = max(step - o.alignment_first_step, 0)
    return min(1.0, since / o.alignment_ramp_steps)


def perturbed_poses(batch: Batch, error_px: float, generator: torch.Generator) -> Tensor:
    """The true poses query_from_reference, displaced so that anchors move by about error_px."""
    depth = batch.points[..., 2].median(dim=1).values
    xi = torch.randn(len(depth), 6, generator=generator).to(depth.device) * 0.6
    angle = error_px / batch.K_query[:, 0]
    size = torch.stack([angle * depth] * 3 + [angle] * 3, 1)
    return se3_exp(xi * size) @ batch.query_from_reference


def append(log: Path, row: Mapping[str, float]) -> None:
    """Append a row to a run's CSV; writes the header first if the file is new."""
    new = not log.exists()
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", newline="") as file:
        writer = csv.DictWriter(file, row.keys())
        if new:
            writer.writeheader()
        writer.writerow({name: f"{value:.5g}" for name, value in row.items()})


@dataclass(frozen=True)
class TrainingProcess:
    """This process's rank among `count`, and its device."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    def from_environment(cls) -> TrainingProcess:
        """Join the group that torchrun describes in RANK, WORLD_SIZE and LOCAL_RANK, if any."""
        cuda = torch.cuda.is_available()
        count = int(os.environ.get("WORLD_SIZE", "1"))
        local = int(os.environ.get("LOCAL_RANK", "0"))
        device = torch.device(f"cuda:{local}" if cuda else "cpu")
        if count == 1:
            return cls(0, 1, device)
        if cuda:
            torch.cuda.set_device(device)
        if not dist.is_initialized():
            dist.init_process_group("nccl" if cuda else "gloo")
        return cls(dist.get_rank(), count, device)

    def average_gradients(self, parameters: Sequence[nn.Parameter]) -> None:
        """Replace every process's gradients by their mean, so that all take the same step.

        All gradients are sent as one message: the networks are small, so overlapping with the
        backward pass would gain nothing.
        """
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        for gradient, mean in zip(
            gradients, flat.split([g.numel() for g in gradients]), strict=True
        ):
            gradient.copy_(mean.view_as(gradient))
