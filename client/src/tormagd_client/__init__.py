"""The client library of the daemon, which `tormagctl` uses too. For asyncio: `tormagd_client.aio`."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tormagd_client.blocking import Client
    from tormagd_client.errors import ClientError, InFaultError, RefusedError, SettingError, UnreachableError

__all__ = ["Client", "ClientError", "InFaultError", "RefusedError", "SettingError", "UnreachableError"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tormagd_client import blocking, errors

    return getattr(blocking if name == "Client" else errors, name)
