import logging

import pytest

from companion.run_cli import OURS, log_to_console


@pytest.fixture(autouse=True)
def levels():
    """Put back what the process-wide loggers had."""
    loggers = [logging.getLogger(name) for name in ("", *OURS)]
    before = [logger.level for logger in loggers]
    yield
    for logger, level in zip(loggers, before, strict=True):
        logger.setLevel(level)


@pytest.mark.parametrize("verbose", [False, True])
def test_verbose_holds_for_our_packages_only(verbose):
    logging.getLogger().setLevel(logging.INFO)
    log_to_console(verbose)
    assert logging.getLogger("mavlink_bridge.bridge").isEnabledFor(logging.DEBUG) == verbose
    assert not logging.getLogger("numba.core.ssa").isEnabledFor(logging.DEBUG)
    assert logging.getLogger("numba.core.ssa").isEnabledFor(logging.INFO)
