"""tormagd: a real-time haptic controller daemon for a magnetorheological-elastomer friction brake."""

from firmware_protocol.build import settle
from tormagd_client import __version__ as __version__

settle()  # chooses the core's build, before anything of it is imported
