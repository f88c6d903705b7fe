"""Which execution provider serves, with stand-ins for those that this machine does not have."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import onnxruntime as ort
import pytest

from localizer.errors import ModelError
from localizer.features import providers
from localizer.features.extractor import SHIPPED_MODEL, OnnxExtractor

NAMES = {"TensorRT": "Tensorrt", "CUDA": "CUDA", "CPU": "CPU", "Azure": "Azure"}
START = ort.InferenceSession

Asked = list[list[Any]]


class Stand:
    """Computes on the CPU and says that it is another provider. fails: on its first image."""

    made: ClassVar[list[Stand]] = []

    def __init__(self, session: ort.InferenceSession, name: str, *, fails: bool) -> None:
        self._session, self._name, self._fails = session, name, fails
        self.sizes: list[tuple[int, ...]] = []
        self.made.append(self)

    def __getattr__(self, name: str) -> object:
        return getattr(self._session, name)

    def get_providers(self) -> list[str]:
        return [self._name, "CPUExecutionProvider"]

    def run(self, outputs: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        self.sizes.append(inputs["image"].shape[1:3])
        if self._fails:
            raise RuntimeError("CUDA failure 2: out of memory\nat line 17")
        found: list[np.ndarray] = self._session.run(outputs, inputs)
        return found


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Asked]:
    """Pretends that providers are installed. broken: how a provider fails: "start", where its
    constructor raises, "silent", where onnxruntime leaves it out, or "run".
    """
    monkeypatch.setenv("PILOT_CACHE", str(tmp_path))
    monkeypatch.setattr(providers, "is_worthwhile", lambda: False)

    def installed(names: list[str], **broken: str) -> Asked:
        asked: Asked = []

        def session(
            path: str, options: object, providers: list[Any], **rest: object
        ) -> ort.InferenceSession | Stand:
            asked.append(providers)
            assert rest == {"enable_fallback": False}
            first = providers[0] if isinstance(providers[0], str) else providers[0][0]
            fault = broken.get(first.removesuffix("ExecutionProvider"), "")
            kept = [f for f in tmp_path.glob("tensorrt/*") if f.read_bytes() == b"damaged"]
            if fault == "kept" and kept:
                raise RuntimeError(f"could not deserialize engine from cache: {kept[0]}")
            if fault == "start":
                raise RuntimeError("libnvinfer.so.10: cannot open shared object file\nmore")
            real = START(path, options, providers=["CPUExecutionProvider"])
            if fault == "silent":
                return real
            return Stand(real, first, fails=fault == "run")

        there = [f"{NAMES[name]}ExecutionProvider" for name in names]
        monkeypatch.setattr(ort, "get_available_providers", lambda: there)
        monkeypatch.setattr(ort, "InferenceSession", session)
        return asked

    return installed


def names(providers: list[Any]) -> list[str]:
    first = [p if isinstance(p, str) else p[0] for p in providers]
    return [name.removesuffix("ExecutionProvider") for name in first]


@pytest.mark.parametrize(
    ("there", "wanted", "serves"),
    [
        (["CPU"], ["CPU"], "CPU"),
        (["CPU", "CUDA"], ["CUDA", "CPU"], "CUDA"),
        (["Azure", "CPU", "CUDA", "TensorRT"], ["Tensorrt", "CUDA", "CPU"], "TensorRT"),
    ],
)
def test_the_best_installed_provider_serves_and_is_named(
    there: list[str], wanted: list[str], serves: str, install: Callable[..., Asked],
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    asked = install(there)
    with caplog.at_level(logging.INFO):
        loaded = OnnxExtractor(SHIPPED_MODEL)
    assert [names(providers) for providers in asked] == [wanted]
    assert loaded.name == f"tiny (onnxruntime, {serves})"
    assert caplog.messages == [f"features: tiny (onnxruntime, {serves})"]


@pytest.mark.parametrize("fault", ["start", "silent", "run"])
def test_a_provider_that_fails_hands_over_in_one_line(fault, install, caplog):
    why = {"start": "libnvinfer.so.10: cannot open shared object file",
           "silent": "its libraries could not be loaded",
           "run": "out of memory"}  # fmt: skip
    asked = install(["TensorRT", "CUDA", "CPU"], Tensorrt=fault)
    with caplog.at_level(logging.INFO):
        loaded = OnnxExtractor(SHIPPED_MODEL)
    assert loaded.provider == "CUDA"
    assert len(asked) == 2
    warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warnings) == 1
    assert warnings[0].startswith("features: TensorRT does not run tiny.onnx, trying CUDA: ")
    assert why[fault] in warnings[0]
    assert "\n" not in warnings[0]


def test_down_to_the_cpu_and_no_further(install, caplog):
    install(["TensorRT", "CUDA", "CPU"], Tensorrt="start", CUDA="run")
    assert OnnxExtractor(SHIPPED_MODEL).provider == "CPU"
    assert len(caplog.messages) == 2
    install(["CUDA", "CPU"], CUDA="start", CPU="start")
    with pytest.raises(ModelError, match="cannot load"):
        OnnxExtractor(SHIPPED_MODEL)
    install(["Azure"])
    with pytest.raises(ModelError, match="no provider"):
        OnnxExtractor(SHIPPED_MODEL)


def test_one_provider_can_be_asked_for(install: Callable[..., Asked]) -> None:
    asked = install(["TensorRT", "CUDA", "CPU"])
    assert OnnxExtractor(SHIPPED_MODEL, only="CUDA").provider == "CUDA"
    assert [names(providers) for providers in asked] == [["CUDA"]]
    install(["CPU"])
    with pytest.raises(ModelError, match="has no CUDA"):
        OnnxExtractor(SHIPPED_MODEL, only="CUDA")


def test_it_is_warmed_up_at_the_size_of_the_flight(install: Callable[..., Asked]) -> None:
    install(["CUDA", "CPU"])
    OnnxExtractor(SHIPPED_MODEL, size=(96, 72))
    assert Stand.made[-1].sizes == [(72, 96)]


def test_tensorrt_keeps_its_engine_and_knows_the_sizes(install, tmp_path):
    prefixes = set()
    for size, half in (((320, 240), False), ((320, 240), True), ((640, 360), True)):
        asked = install(["TensorRT", "CUDA", "CPU"])
        OnnxExtractor(SHIPPED_MODEL, size=size, half=half)
        name, options = asked[0][0]
        assert name == "TensorrtExecutionProvider"
        assert options["trt_engine_cache_enable"] == "True"
        assert Path(options["trt_engine_cache_path"]).is_relative_to(tmp_path)
        assert Path(options["trt_engine_cache_path"]).is_dir()
        assert options["trt_fp16_enable"] == str(half)
        shapes = [
            [int(n) for n in options[f"trt_profile_{k}_shapes"].removeprefix("image:").split("x")]
            for k in ("min", "opt", "max")
        ]
        assert shapes[1] == [1, size[1], size[0], 3]
        assert all(a <= b <= c for a, b, c in zip(*shapes, strict=True))
        prefixes.add(options["trt_engine_cache_prefix"])
    assert len(prefixes) == 3


def test_a_kept_engine_that_is_damaged_is_built_anew(install, tmp_path, caplog):
    """As after a power cut while it was written: TensorRT refuses it at every start."""
    asked = install(["TensorRT", "CUDA", "CPU"])
    OnnxExtractor(SHIPPED_MODEL)
    prefix = asked[0][0][1]["trt_engine_cache_prefix"]
    folder = tmp_path / "tensorrt"
    for name in (f"{prefix}_sm87.engine", "TensorrtExecutionProvider_cache_sm87.timing"):
        (folder / name).write_bytes(b"damaged")
    (folder / "another-models.engine").write_bytes(b"sound")
    install(["TensorRT", "CUDA", "CPU"], Tensorrt="kept")
    assert OnnxExtractor(SHIPPED_MODEL).provider == "TensorRT"
    assert [f.name for f in folder.iterdir()] == ["another-models.engine"]
    assert len(caplog.messages) == 1
    assert "TensorRT builds its engine again: could not deserialize" in caplog.messages[0]


def test_what_was_kept_is_not_always_to_blame(install, tmp_path, caplog):
    asked = install(["TensorRT", "CUDA", "CPU"])
    OnnxExtractor(SHIPPED_MODEL)
    (tmp_path / "tensorrt" / asked[0][0][1]["trt_engine_cache_prefix"]).write_bytes(b"sound")
    install(["TensorRT", "CUDA", "CPU"], Tensorrt="run")
    assert OnnxExtractor(SHIPPED_MODEL).provider == "CUDA"
    assert "does not run tiny.onnx, trying CUDA" in caplog.messages[-1]


@pytest.mark.parametrize("how", ["a file", "not to be written"])
def test_a_cache_folder_that_takes_no_engine_is_told(
    how: str, install: Callable[..., Asked], tmp_path: Path, caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    asked = install(["TensorRT", "CUDA", "CPU"])
    if how == "a file":
        (tmp_path / "tensorrt").write_bytes(b"")
    else:  # root, as whom tests may run, is refused nothing
        monkeypatch.setattr("os.access", lambda *_: False)
    assert OnnxExtractor(SHIPPED_MODEL).provider == "TensorRT"
    _, options = asked[0][0]
    assert not any("cache" in key for key in options)
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("features: TensorRT's engine is not kept: ")
    assert str(tmp_path / "tensorrt") in caplog.messages[0]


def test_cuda_is_loaded_from_python_packages_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def preload(directory: str) -> None:
        asked.append(directory)

    providers.load_cuda_packages.cache_clear()
    monkeypatch.setattr(ort, "preload_dlls", preload)
    for names, expected in ((["CPU"], []), (["CUDA", "CPU"], [""]), (["CUDA", "CPU"], [""])):
        there = [f"{name}ExecutionProvider" for name in names]
        monkeypatch.setattr(ort, "get_available_providers", lambda there=there: there)
        assert set(there) <= set(providers.available_providers())
        assert asked == expected
    providers.load_cuda_packages.cache_clear()
