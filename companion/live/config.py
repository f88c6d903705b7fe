"""The console's settings."""

from __future__ import annotations

import ipaddress
from pathlib import Path

from pydantic import Field, model_validator

from mavlink_bridge.config import StrictModel


class ConsoleConfig(StrictModel):
    """Settings of the console: address of the operator's page, and its rights."""

    listen: str = Field(
        "127.0.0.1:8080",
        pattern=r"^(\[[0-9a-fA-F:]+\]|[0-9.]+|localhost):\d{1,5}$",
        description="address:port; other than loopback needs token_file",
    )
    control: bool = Field(
        False, description="the page may set targets and hints and change settings"
    )
    token_file: Path | None = Field(None, description="token file, mode 0600")
    hosts: tuple[str, ...] = Field((), description="host names of the page")
    tls_certificate: Path | None = Field(None, description="PEM certificate, with tls_key")
    tls_key: Path | None = None
    frames_hz: float = Field(6.0, ge=0.2, le=15.0, description="frames per second on the page")

    @model_validator(mode="after")
    def _is_guarded(self) -> ConsoleConfig:
        if not self.is_loopback and self.token_file is None:
            raise ValueError("token_file is needed where listen is not a loopback address")
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together")
        if not 0 < self.port < 65536:
            raise ValueError("listen: the port is 1 to 65535")
        return self

    @property
    def host(self) -> str:
        """Listening address without brackets."""
        return self.listen.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """TCP port on which the page is served."""
        return int(self.listen.rpartition(":")[2])

    @property
    def is_loopback(self) -> bool:
        """Whether the page can be reached from this machine only."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def url(self) -> str:
        """URL of the page on this machine."""
        scheme = "http" if self.tls_certificate is None else "https"
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"
