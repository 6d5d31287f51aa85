"""`tormagd_client.aio` by its older name."""

from tormagd_client.aio import AsyncClient

__all__ = ["AsyncClient"]
