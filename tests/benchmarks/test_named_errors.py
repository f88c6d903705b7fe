"""What a benchmark says of bad input."""

from __future__ import annotations

import pytest

from benchmarks.common.named_errors import named_errors
from localizer.errors import ModelError


@pytest.mark.parametrize("error", [ModelError("a.onnx: no"), FileNotFoundError("a.csv")])
def test_a_named_error_is_one_line(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, named_errors():
        raise error
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"{type(error).__name__}: {error}\n"
