"""The client of the distribution `tormagd-client` by its older name. For asyncio: `tormagd_client.aio`."""

from tormagd_client.blocking import Client
from tormagd_client.errors import ClientError, InFaultError, RefusedError, SettingError, UnreachableError

__all__ = ["Client", "ClientError", "InFaultError", "RefusedError", "SettingError", "UnreachableError"]
