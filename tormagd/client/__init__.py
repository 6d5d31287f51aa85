"""What a program of your own speaks to the daemon with; `tormagctl` does, too. For asyncio: `tormagd.client.aio`."""

from tormagd.client.blocking import Client
from tormagd.client.errors import ClientError, InFaultError, RefusedError, SettingError, UnreachableError

__all__ = ["Client", "ClientError", "InFaultError", "RefusedError", "SettingError", "UnreachableError"]
