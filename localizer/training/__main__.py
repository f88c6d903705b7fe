"""Training from the command line: ``python -m localizer.training COMMAND``."""

from __future__ import annotations

import logging
import sys
import threading
from concurrent.futures import Future
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from localizer.errors import LocalizerError

try:
    from localizer.training.config import LiveSection, TrainConfig, load_config
    from localizer.training.data.pairs import FIRST_WORLD_SEED
    from localizer.training.data.shards import write_shards, write_world_shards
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    typer.echo("training needs PyTorch: pip install -e '.[train]' in the source folder", err=True)
    sys.exit(2)

app = typer.Typer(
    help=__doc__, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)

ConfigPath = Annotated[Path, typer.Argument(help="YAML file of the run, see configs/.")]


@app.command()
def generate(config: ConfigPath) -> None:
    """Write the run's shards that are not on disk yet."""
    _generate(load_config(config))


@app.command()
def train(
    config: ConfigPath,
    steps: Annotated[int | None, typer.Option(help="Stop after so many more steps.")] = None,
) -> None:
    """Train, from the checkpoint where there is one; shards are generated alongside.

    On several GPUs: torchrun --nproc-per-node N -m localizer.training train CONFIG.
    """
    from localizer.training.loop.train import Trainer

    loaded = load_config(config)
    trainer = Trainer(loaded)
    trainer.run(steps, _generating(loaded) if trainer.workers.rank == 0 else None)


@app.command()
def export(
    checkpoint: Annotated[Path, typer.Argument(help="Checkpoint (.pt) of a run.")],
    model: Annotated[Path, typer.Argument(help="ONNX file to write; its JSON goes beside it.")],
    float16: Annotated[bool, typer.Option("--float16", help="Half precision; s0 only.")] = False,
) -> None:
    """Write a checkpoint's averaged weights as an ONNX model with its description."""
    from localizer.training.export.export import export as write

    parity = write(checkpoint, model, half=float16)
    typer.echo(
        f"{model}: largest difference to torch in float32 {parity.difference:.2g}, "
        f"least mean cosine {parity.cosine:.6f}"
    )


def _generating(config: TrainConfig) -> Future[None]:
    """Start `_generate` on a thread that ends with the process."""
    done: Future[None] = Future()

    def generate() -> None:
        try:
            _generate(config)
        except Exception as error:
            done.set_exception(error)
        else:
            done.set_result(None)

    threading.Thread(target=generate, daemon=True).start()
    return done


def _generate(config: TrainConfig) -> None:
    """Generate shards in the order of their use: first scenes, mesh worlds, other scenes."""
    data = config.data
    if isinstance(data, LiveSection):
        return  # it makes its pairs while it trains
    photos, scenes = data.library(), data.scene_config()
    first = range(data.first_seed, data.first_seed + min(data.initial_scenes, data.scenes))
    rest = range(first.stop, data.first_seed + data.scenes)
    worlds = range(FIRST_WORLD_SEED, FIRST_WORLD_SEED + data.worlds)
    for path in chain(
        write_shards(data.shards, first, scenes, photos, data.workers),
        write_world_shards(data.shards, worlds, scenes),
        write_shards(data.shards, rest, scenes, photos, data.workers),
    ):
        logging.getLogger(__name__).debug("%s", path)


def main() -> None:
    """Entry point: named errors become one clear line and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    try:
        app()
    # OSError: of a disk or a folder, which the program cannot help and which names its path.
    except (LocalizerError, OSError) as error:
        typer.echo(f"{type(error).__name__}: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
