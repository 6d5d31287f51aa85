"""tormagd: a real-time haptic controller daemon for a magnetorheological-elastomer friction brake."""

from firmware_protocol.build import settle

settle()  # which build of the core runs, before anything of it is imported

__version__ = "0.1.0"
