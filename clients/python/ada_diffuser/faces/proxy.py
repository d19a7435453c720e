"""Which proxy of the environment carries gRPC to a host: none to this machine, and an error names the one that does.

The REST face knows no proxies. gRPC's own rules take one for loopback addresses too, and its errors then speak of the proxy's address
as if it were the server's.
"""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass
from urllib.parse import urlsplit


@dataclass(frozen=True)
class Proxy:
    """A proxy and who named it."""

    #: The environment variable.
    variable: str
    #: `host:port`, without the credentials that the variable may hold.
    address: str

    def __str__(self) -> str:
        return f"through the proxy {self.address} of the environment's {self.variable}; name the host in no_proxy to go without"


def proxy_to(host: str) -> Proxy | None:
    """The proxy that gRPC takes to `host`, by the first set of the variables that it reads; None for this machine."""
    if _is_loopback(host) or _is_excepted(host):
        return None
    for variable in ("grpc_proxy", "https_proxy", "http_proxy"):
        if url := os.environ.get(variable):
            parts = urlsplit(url)
            # gRPC passes over any other kind, and one without `http://`.
            return Proxy(variable, parts.netloc.rpartition("@")[2]) if parts.scheme == "http" else None
    return None


def _is_loopback(host: str) -> bool:
    if host.lower() == "localhost" or host.lower().endswith(".localhost"):
        return True
    address = _address(host)
    return address is not None and address.is_loopback


def _is_excepted(host: str) -> bool:
    """Whether no_grpc_proxy, else no_proxy, lists the host, a domain that it is of, or a network that it is in."""
    entries = os.environ.get("no_grpc_proxy") or os.environ.get("no_proxy") or ""  # noqa: SIM112
    return any(_matches(host.lower(), entry.strip().lower()) for entry in entries.split(",") if entry.strip())


def _matches(host: str, entry: str) -> bool:
    address = _address(host)
    try:
        if address is not None and address in ipaddress.ip_network(entry, strict=False):
            return True
    except ValueError:
        pass  # a name, and no network
    return entry == "*" or host.endswith(entry)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
